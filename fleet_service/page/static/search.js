// Search for a place, a road, a coordinate or a cell number; list of the areas with data.
import { make } from "./elements.js";
import { CELLS, middleOf, worldX, worldY } from "./grid.js";
import { showArea, showPlace } from "./navigation.js";
import { say } from "./texts.js";
import { coordinates } from "./words.js";

const MOST = 8;
const AREA_ZOOM = 16;

// Return the possible meanings of a text, the best first: { words, go }.
export function found(page, text) {
  const asked = text.trim().toLowerCase();
  const answers = [];
  if (!asked) return answers;
  const point = asked.match(/^(-?\d+(?:\.\d+)?)\s*°?\s*n?\s*[,; ]\s*(-?\d+(?:\.\d+)?)\s*°?\s*e?$/);
  if (point && Math.abs(point[1]) <= 85 && Math.abs(point[2]) <= 180) {
    const [latitude, longitude] = [Number(point[1]), Number(point[2])];
    answers.push({
      words: say("search.point", { place: coordinates(longitude, latitude) }),
      go: () => showPlace(page, worldX(longitude), worldY(latitude)),
    });
  } else if (/^\d{9,13}$/.test(asked) && Number(asked) < CELLS * CELLS)
    answers.push({
      words: say("search.cell", { cell: asked }),
      go: () => {
        const { x, y } = middleOf(Number(asked));
        showPlace(page, x, y);
      },
    });
  for (const name of page.state.roads?.names ?? [])
    if (name.toLowerCase().includes(asked))
      answers.push({
        words: name,
        kind: say("search.road"),
        go: () => page.map.view.fit(page.state.roads.extentOf(name)),
      });
  for (const area of page.state.areas)
    if (areaName(area).toLowerCase().includes(asked))
      answers.push({
        words: areaName(area),
        kind: say("search.area"),
        go: () => showArea(page, area),
      });
  for (const place of page.state.roads?.places ?? [])
    if (place.name.toLowerCase().includes(asked) && !answers.some(one => one.words === place.name))
      answers.push({
        words: place.name,
        kind: say("search.place"),
        go: () => page.map.view.go(worldX(place.longitude), worldY(place.latitude), AREA_ZOOM),
      });
  return answers.slice(0, MOST);
}

export const areaName = area => area.name || coordinates(area.longitude, area.latitude);

export function searchBox(page) {
  const list = make("ul", {
    class: "results",
    id: "results",
    role: "listbox",
    hidden: true,
    "aria-label": say("search.results"),
  });
  const box = make("input", {
    type: "search",
    id: "search",
    placeholder: say("search.hint"),
    "aria-label": say("search.label"),
    autocomplete: "off",
  });
  const close = () => {
    list.hidden = true;
  };
  const pick = answer => {
    close();
    answer.go();
  };
  const fill = () => {
    const answers = found(page, box.value);
    list.replaceChildren(
      ...(answers.length
        ? answers.map(answer =>
            make(
              "li",
              { role: "option" },
              make(
                "button",
                { type: "button", onclick: () => pick(answer) },
                answer.words,
                answer.kind ? make("small", {}, answer.kind) : null,
              ),
            ),
          )
        : [make("li", { role: "option", class: "note" }, say("search.nothing"))]),
    );
    list.hidden = !box.value.trim();
    return answers;
  };
  box.addEventListener("input", fill);
  box.addEventListener("keydown", e => {
    if (e.key === "Enter") {
      const answers = fill();
      if (answers.length) pick(answers[0]);
    } else if (e.key === "Escape") close();
    else if (e.key === "ArrowDown") list.querySelector("button")?.focus();
  });
  return [box, list];
}

export function areaList(page) {
  if (!page.state.areas.length)
    return [
      make(
        "p",
        { class: "quiet" },
        say(page.state.cells.known.size ? "card.loading" : "areas.none"),
      ),
    ];
  return [
    make(
      "ul",
      { class: "areas" },
      ...page.state.areas.map(area =>
        make(
          "li",
          {},
          make(
            "a",
            {
              class: "area",
              href: "#area",
              onclick: e => {
                e.preventDefault();
                showArea(page, area);
              },
            },
            make("strong", {}, areaName(area)),
            make(
              "span",
              {},
              say("areas.line", {
                cells: area.cells.toLocaleString(document.documentElement.lang),
                alerts: area.alerts,
              }),
            ),
          ),
        ),
      ),
    ),
  ];
}
