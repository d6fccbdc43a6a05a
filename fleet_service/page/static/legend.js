// Legend for new users: all kinds of cells, from the most dangerous to the unknown.
import { byId, make } from "./elements.js";
import { DANGER, HOLLOW, LITTLE } from "./colours.js";
import { setOption } from "./options.js";
import { say } from "./texts.js";

const RECENT = [0, 900, 3600, 21600];

function colourClass(kind) {
  if (kind === HOLLOW) return "hollow";
  if (kind === LITTLE) return "little";
  return kind > 3 ? `k${kind} two` : `k${kind}`;
}

const ribbon = kind => make("span", { class: `ribbon ${colourClass(kind)}` });

// Return the certainty of a kind, as in the keys of the texts.
function certaintyOf(kind) {
  if (kind < 4) return "well";
  if (kind < LITTLE) return "roughly";
  return kind === LITTLE ? "hardly" : "bound";
}

export const ladder = () =>
  make(
    "ul",
    { class: "ladder" },
    ...DANGER.map(kind =>
      make(
        "li",
        { "data-kind": kind },
        ribbon(kind),
        make(
          "span",
          {},
          say(`legend.kind.${kind}`),
          make("small", {}, say(`legend.sure.${certaintyOf(kind)}`)),
        ),
      ),
    ),
  );

// The short legend on the map itself.
export function mapKey() {
  byId("key").replaceChildren(
    ...DANGER.map(kind =>
      make(
        "div",
        {},
        make("span", { class: `swatch ${kind === HOLLOW ? "hollow" : `k${kind}`}` }),
        say(`legend.short.${kind}`),
      ),
    ),
    make("div", {}, make("span", { class: "swatch ground" }), say("legend.short.nobody")),
  );
}

export function legend(page) {
  const line = (kind, key) =>
    make("li", {}, make("span", { class: `swatch ${kind}` }), make("span", {}, say(key)));
  return [
    make("h2", {}, say("legend.head")),
    make("p", {}, say("legend.intro")),
    ladder(),
    make(
      "ul",
      { class: "plain" },
      page.state.show.borrowed ? line("borrowed", "legend.borrowed") : null,
      line("ground", "legend.nobody"),
      line("away", "legend.away"),
      line("ring", "legend.alert"),
      page.settings.overlay ? line("truth", "legend.overlay") : null,
    ),
    make("p", { class: "note" }, say("legend.heading")),
    make("p", { class: "note" }, say("legend.worst")),
    make("h2", {}, say("legend.show")),
    ...shows(page),
  ];
}

function shows(page) {
  const box = name =>
    make(
      "label",
      { class: "line" },
      make("input", {
        type: "checkbox",
        id: `show-${name}`,
        checked: page.state.show[name],
        onchange: e => setOption(page, name, e.target.checked),
      }),
      say(`show.${name}`),
    );
  const choice = make(
    "select",
    { id: "show-recent", onchange: e => setOption(page, "recent", Number(e.target.value)) },
    ...RECENT.map(s =>
      make(
        "option",
        { value: String(s), selected: page.state.show.recent === s },
        say(`show.recent.${s}`),
      ),
    ),
  );
  return [
    box("roads"),
    box("bounds"),
    page.settings.overlay ? box("overlay") : null,
    box("borrowed"),
    make("label", { class: "line" }, say("show.recent"), choice),
  ].filter(Boolean);
}
