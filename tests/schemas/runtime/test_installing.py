"""Tests of hints on installing an extra. A hint must name the source of this distribution, because
the distribution is in no package index.
"""

from __future__ import annotations

import json
from importlib import metadata
from typing import Any

import pytest

from schemas.runtime.installing import install_command


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (
            {"url": "file:///src/grip", "dir_info": {"editable": True}},
            "pip install --editable '/src/grip[page]'",
        ),
        ({"url": "file:///src/grip", "dir_info": {}}, "pip install '/src/grip[page]'"),
        (
            {"url": "file:///d/g.whl", "archive_info": {}},
            "pip install 'gripmap[page] @ file:///d/g.whl'",
        ),
        (None, "pip install '.[page]' in a checkout, or the wheel with [page]"),
    ],
)
def test_the_hint_installs_from_the_same_place(
    origin: dict[str, Any] | None, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Installed:
        def read_text(self, name: str) -> str | None:
            assert name == "direct_url.json"
            return None if origin is None else json.dumps(origin)

    monkeypatch.setattr(metadata, "distribution", lambda _: Installed())
    assert install_command("page") == command


def test_a_source_tree_that_was_never_installed_has_a_hint_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def raise_missing(_: str) -> None:
        raise metadata.PackageNotFoundError

    monkeypatch.setattr(metadata, "distribution", raise_missing)
    assert "[metrics]" in install_command("metrics")
