"""Apache Iceberg tables of an archive's compacted (sorted) files. Files are registered without
copying; new rows in the inbox are never registered.

Only one process may register files of a table. Before retention or erasure removes or rewrites
files, these files are removed from the tables (`unregister_files`), because a table that refers to
a missing file cannot be read.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import pyarrow as pa

from fleet_service.archive.format import layout
from fleet_service.archive.format.segments import SCHEMAS
from fleet_service.archive.maintenance.compaction import hold_compaction_lock
from schemas.errors import InputError
from schemas.runtime.durable import open_durably
from schemas.runtime.installing import install_command
from schemas.wire import Kind

Catalog: TypeAlias = Any  # a class of pyiceberg, which is an optional package
Table: TypeAlias = Any

RECORD: Final = "iceberg.json"  # file in the archive that states where its files are registered
NAMESPACE: Final = "gripmap"
PROPERTIES: Final = {
    # Without minima and maxima, the metadata of the tables contain no pseudonyms.
    "write.metadata.metrics.column.vehicle": "counts",
    "write.metadata.delete-after-commit.enabled": "true",
    "write.metadata.previous-versions-max": "20",
    "commit.retry.num-retries": "10",  # several archives may be registered at the same time
}


class Place(NamedTuple):
    """Iceberg registration of an archive.

    Attributes:
        catalog: a name in pyiceberg's configuration, or the URI of an SQL catalogue
            (`sqlite:////var/lib/tables.db`).
        namespace: namespace of the tables `observations` and `states`.
        url: URL at which readers of the tables find the archive's folder, its mirror or its copy.
    """

    catalog: str
    namespace: str
    url: str


class RegistrationResult(NamedTuple):
    """Result of a registration: number of files added to the tables, number of files removed from
    them, and number of the archive's rows that they now contain.
    """

    added: int
    dropped: int
    rows: int


def register_files(root: Path, place: Place) -> RegistrationResult:
    """Register the compacted (sorted) files of an archive in the Iceberg tables; a repeated call
    changes nothing.

    Files of other archives in the same tables stay registered.

    Raises:
        InputError: pyiceberg is not installed, the catalogue refuses, or a file cannot be read at
            the URL `place.url`.
        OSError: the archive cannot be read or written.
    """
    total = RegistrationResult(0, 0, 0)
    with hold_compaction_lock(root):  # no other process may remove or rewrite files meanwhile
        _record_registration(root, place)
        with _one_line_errors(place):
            catalog = _open_catalog(place)
            catalog.create_namespace_if_not_exists(place.namespace)
            for kind in Kind:
                done = _brought_up(_open_table(catalog, place, kind), root, place, kind)
                total = RegistrationResult(*map(sum, zip(total, done, strict=True)))
    return total


def unregister_files(root: Path, paths: Sequence[Path]) -> None:
    """Remove files from the Iceberg tables, before they are removed or rewritten on disk.

    Raises:
        InputError: the archive is registered and pyiceberg is not installed, or the catalogue
            refuses.
    """
    place = place_of(root)
    if place is None or not paths:
        return
    names = {_file_url(root, place, path) for path in paths}
    with _one_line_errors(place):
        catalog = _open_catalog(place)
        for kind in Kind:
            if catalog.table_exists((place.namespace, layout.TABLES[kind])):
                table = catalog.load_table((place.namespace, layout.TABLES[kind]))
                _commit_files(
                    table,
                    [file for name, file in _files_by_name(table).items() if name in names],
                    [],
                )


def place_of(root: Path) -> Place | None:
    """Return the Iceberg registration of an archive; None if it has none.

    Raises:
        InputError: the file with the registration is damaged. The caller must not treat the archive
            as unregistered, because Iceberg tables may refer to its files.
    """
    path = root / RECORD
    try:
        recorded = json.loads(path.read_bytes())
        return Place(recorded["catalog"], recorded["namespace"], recorded["at"])
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            "archive", f"{path} is damaged ({error})", "run export iceberg again"
        ) from error


def _record_registration(root: Path, place: Place) -> None:
    """Record in the archive the Iceberg tables in which its files will be registered. The record
    must precede the registration. Otherwise a crash between the two could leave registered files
    that `unregister_files` does not find, and the tables would refer to missing files.
    """
    path = root / RECORD
    try:
        before = place_of(root)
    except InputError:  # the record is damaged; write it again
        before = None
    if before is not None and before != place:
        problem = (
            f"this archive is registered at {before.catalog}, namespace {before.namespace}, "
            f"files at {before.url}"
        )
        raise InputError(
            "catalog", problem, f"give the same values; or drop those tables and remove {path}"
        )
    if before is None:
        record = {"catalog": place.catalog, "namespace": place.namespace, "at": place.url}
        with open_durably(path) as file:
            file.write(json.dumps(record).encode())


def _open_catalog(place: Place) -> Catalog:
    try:
        from pyiceberg.catalog import load_catalog
    except ImportError as error:
        raise InputError(
            "catalog", "pyiceberg is not installed", install_command("iceberg")
        ) from error
    if not place.catalog.startswith(("sqlite://", "postgresql")):
        return load_catalog(place.catalog)
    catalog_properties = {"type": "sql", "uri": place.catalog}
    # The metadata of the tables are stored next to the catalogue's file.
    if place.catalog.startswith("sqlite:///"):
        warehouse = Path(place.catalog.removeprefix("sqlite:///")).absolute().with_suffix("")
        catalog_properties["warehouse"] = f"file://{warehouse}"
    # Other programs find the tables under this catalogue name.
    return load_catalog("gripmap", **catalog_properties)


def _open_table(catalog: Catalog, place: Place, kind: Kind) -> Table:
    """Return the Iceberg table of observations or of states; create it or add missing columns if
    necessary.
    """
    from pyiceberg.transforms import DayTransform

    name = (place.namespace, layout.TABLES[kind])
    schema = SCHEMAS[kind]
    if not catalog.table_exists(name):
        new = catalog.create_table_transaction(
            name, schema=_plain_schema(schema), properties=PROPERTIES
        )
        with new, new.update_spec() as spec:  # one partition per date, as in compacted files
            spec.add_field(layout.TIME[kind], DayTransform(), "date")
    table = catalog.load_table(name)
    if set(schema.names) - {field.name for field in table.schema().fields}:
        with table.update_schema() as update:
            update.union_by_name(_plain_schema(schema))
    return table


def _plain_schema(schema: pa.Schema) -> pa.Schema:
    return pa.schema([field.with_nullable(True).remove_metadata() for field in schema])


def _brought_up(table: Table, root: Path, place: Place, kind: Kind) -> RegistrationResult:
    """Bring an Iceberg table up to date in one commit: remove the entries of files that are missing
    or have changed on disk, and add new files.
    """
    archived_files = {
        _file_url(root, place, path): path for path in layout.compacted_files(root, kind)
    }
    own = {
        name: file
        for name, file in _files_by_name(table).items()
        if name.startswith(_folder_url(place))
    }
    # A file that was rewritten under the same name is recognised by its size.
    stale = [
        n
        for n, file in own.items()
        if n not in archived_files or archived_files[n].stat().st_size != file.file_size_in_bytes
    ]
    missing = sorted((archived_files.keys() - own.keys()) | (archived_files.keys() & set(stale)))
    _commit_files(table, [own[name] for name in stale], missing)
    now = _files_by_name(table.refresh())
    return RegistrationResult(
        len(missing), len(stale), sum(f.record_count for n, f in now.items() if n in archived_files)
    )


def _commit_files(table: Table, removed: list[Any], added: list[str]) -> None:
    """Remove files from an Iceberg table and add others, as one atomic change."""
    if not removed and not added:
        return
    with table.transaction() as change:
        if removed:
            with change.update_snapshot().overwrite() as without:
                for file in removed:
                    without.delete_data_file(file)
        if added:
            # The caller has already excluded duplicates (`_files_by_name`).
            change.add_files(added, check_duplicate_files=False)


def _files_by_name(table: Table) -> dict[str, Any]:
    """Return the files to which an Iceberg table refers, by URL."""
    return {task.file.file_path: task.file for task in table.scan().plan_files()}


def _folder_url(place: Place) -> str:
    return place.url.rstrip("/") + "/"


def _file_url(root: Path, place: Place, path: Path) -> str:
    return _folder_url(place) + str(path.relative_to(root))


@contextmanager
def _one_line_errors(place: Place) -> Iterator[None]:
    """Convert any error of the Iceberg catalogue inside the block into an InputError with a message
    of one line (context manager).
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # each catalogue library has exceptions of its own
        fix = "check that the catalog can be reached, then run the command again"
        raise InputError(
            "catalog", f"{place.catalog}: {type(error).__name__}: {error}", fix
        ) from error
