"""Tests that HTML maps of answers work in a real browser with mouse, touch and keyboard."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_service.analytics import output
from fleet_service.analytics.page import GRIP_SCALE, DrawnCells, render_page
from fleet_service.analytics.questions import QUESTIONS
from fleet_service.cli import main
from schemas import grid
from schemas.runtime.palette import GRIP_RANGE, shade
from tests.browser import open_page
from tests.fleet_service.analytics.test_analyze import DAYS
from tests.fleet_service.examples import CELL

pytestmark = pytest.mark.campaign  # starting a browser takes seconds

PLACED = [name for name, question in QUESTIONS.items() if question.colour]


@pytest.fixture(scope="module")
def pages(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the HTML page of every question (predefined query) whose answer has cells, by name.
    The page named `frames` shows an animation: the answer to the question `replay` at several
    times.
    """
    folder = tmp_path_factory.mktemp("pages")
    more: dict[str, list[str]] = {name: [] for name in PLACED} | {"frames": ["--step", "21600"]}
    for name, words in more.items():
        question = "replay" if name == "frames" else name
        command = [
            "analyze",
            question,
            "--archive",
            str(archive),
            *DAYS,
            *words,
            "--out",
            str(folder / f"{name}.html"),
        ]
        assert main(command) == 0
    return {name: folder / f"{name}.html" for name in more}


@pytest.mark.parametrize("name", [*PLACED, "frames"])
def test_a_page_opens_without_an_error_or_a_network_and_draws_its_cells(
    pages: dict[str, Path], name: str
) -> None:
    with open_page(pages[name]) as found:
        assert found.errors == []
        assert found.requests == [pages[name].resolve().as_uri()]
        assert found.drawn_count > 3
        assert len(found.count_colours()) > 3
        assert found.page.locator("#frames").is_visible() == (name in ("frames", "grip"))


def cells(values: list[float | None], lasting: list[bool] | None = None) -> DrawnCells:
    boxes = np.stack(grid.bounds(CELL + np.arange(len(values))), axis=1).tolist()
    rows = [[str(value)] for value in values]
    return DrawnCells(
        boxes, [0, 1, 2, 3][: len(values)], {"map": values}, ["mu"], rows, lasting=lasting
    )


def test_unmeasured_cells_have_no_colour_of_the_scale(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text(render_page("two", cells([0.9, None]), GRIP_SCALE))
    dry = ",".join(str(int(shade(0.9, *GRIP_RANGE)[k : k + 2], 16)) for k in (1, 3, 5))
    with open_page(path) as found:
        colours = found.count_colours()
        assert colours[dry] > 1000
        painted = {name for name, count in colours.items() if count > 200} - {dry}
        for name in painted:
            red, green, blue = map(int, name.split(","))
            assert max(red, green, blue) - min(red, green, blue) < 12, "a bound has a colour"
        assert found.page.locator("#unknown").is_visible()
        assert "0.15 ice" in found.page.locator("#ticks").inner_text()


@pytest.mark.campaign
def test_cells_of_two_continents_open_as_one_area_and_a_list(tmp_path: Path) -> None:
    far = int(grid.cell_of(np.array([37.77]), np.array([-122.42]))[0])
    number = np.concatenate([CELL + np.arange(40), [far, far + 1]])
    boxes = np.stack(grid.bounds(number), axis=1).tolist()
    rows = [["0.3"]] * len(number)
    path = tmp_path / "page.html"
    drawn = DrawnCells(boxes, [0] * len(number), {"map": [0.3] * len(number)}, ["mu"], rows)
    path.write_text(render_page("two", drawn, GRIP_SCALE))
    with open_page(path) as found:
        assert found.drawn_count == 40
        assert (
            found.page.locator("#area option").all_inner_texts()[1].startswith("37.77°, -122.42°")
        )
        found.page.locator("#area").select_option(index=1)
        assert found.drawn_count == 2
        found.page.get_by_role("button", name="all").click()
        assert found.drawn_count == 42


def test_pointing_tapping_and_the_keyboard_read_a_cell(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text(render_page("one", cells([0.2]), GRIP_SCALE))
    with open_page(path) as found:
        canvas = found.page.locator("canvas.map")
        box = canvas.bounding_box()
        assert box is not None
        found.page.mouse.move(box["x"] + box["width"] / 2 + 5, box["y"] + box["height"] / 2)
        assert found.page.locator("#said").inner_text() == "mu 0.2"
        found.page.mouse.move(box["x"] + 3, box["y"] + 3)
        assert "the grip is unknown" in found.page.locator("#said").inner_text()
        canvas.focus()
        found.page.keyboard.press("Enter")
        assert found.page.locator("#said").inner_text() == "mu 0.2"
        for _ in range(30):
            found.page.keyboard.press("ArrowLeft")
        assert "the grip is unknown" in found.page.locator("#said").inner_text()
    with open_page(path, phone=True, ratio=3.0) as found:
        assert found.page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        canvas = found.page.locator("canvas.map")
        assert canvas.evaluate("c => c.width / c.clientWidth") == pytest.approx(3.0, abs=0.02)
        canvas.tap()
        assert found.page.locator("#said").inner_text() == "mu 0.2"


def test_a_finger_moves_the_map(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text(render_page("one", cells([0.2]), GRIP_SCALE))
    with open_page(path, phone=True) as found:
        before = found.count_colours()
        found.page.evaluate("""() => {
          const canvas = document.querySelector("canvas.map"), box = canvas.getBoundingClientRect();
          canvas.setPointerCapture = () => {};
          const send = (type, x) => canvas.dispatchEvent(new PointerEvent(type, {
            pointerId: 7, pointerType: "touch", clientX: box.left + x, clientY: box.top + 200,
            bubbles: true }));
          send("pointerdown", 100); send("pointermove", 2000); send("pointerup", 2000);
        }""")
        assert found.errors == []
        assert sum(found.count_colours().values()) < sum(before.values())


def test_each_frame_is_drawn_alone_and_the_slider_changes_it(pages: dict[str, Path]) -> None:
    with open_page(pages["frames"]) as found:
        first = found.page.locator("#frame").inner_text()
        found.page.locator("#slider").fill("2")
        assert found.page.locator("#frame").inner_text() != first
        assert found.errors == []


def test_frames_seconds_apart_are_frames_of_their_own() -> None:
    frame = pa.array([0, 10_000_000, 20_000_000]).cast(pa.timestamp("us", "UTC"))
    columns = {
        "cell": [CELL] * 3,
        "sector": [0] * 3,
        "mu": [0.2, 0.5, 0.9],
        "p_slippery": [1.0, 0.5, 0.0],
    }
    text = output.make_page(pa.table({**columns, "frame": frame}), QUESTIONS["replay"])
    assert '"frames": ["1970-01-01 00:00:00", "1970-01-01 00:00:10", "1970-01-01 00:00:20"]' in text
    assert '"frame": [0, 1, 2]' in text


def test_a_stretch_is_drawn_as_its_road_and_a_spell_that_lasts_is_marked(tmp_path: Path) -> None:
    bent = grid.interleave(
        np.array([0, 1, 2, 2, 2]) + 1_118_000, np.array([0, 0, 0, 1, 2]) + 630_000
    ).tolist()
    worst = pa.table(
        {"cell": [bent[0]], "sector": [0], "mu": [0.2], "score": [1.0], "members": [bent]}
    )
    (tmp_path / "worst.html").write_text(output.make_page(worst, QUESTIONS["worst"]))
    with open_page(tmp_path / "worst.html") as found:
        assert found.drawn_count == len(bent)
    spells = pa.table(
        {
            "cell": [CELL, CELL + 1],
            "sector": [0, 0],
            "onset": [0, 1],
            "duration_s": [60, 600],
            "lasts": [False, True],
        }
    )
    (tmp_path / "spells.html").write_text(output.make_page(spells, QUESTIONS["spells"]))
    with open_page(tmp_path / "spells.html") as found:
        assert found.page.locator("#lasting").is_visible()
        assert not found.page.locator("#unknown").is_visible()
        assert found.count_colours().get("208,0,111", 0) > 50
