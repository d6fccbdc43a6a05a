// What the colours mean, for somebody who has never seen the page; and what is shown.
import { fills } from "./colours.js";
import { draw, make } from "./elements.js";
import { SIDES } from "./paint.js";
import { say } from "./texts.js";

const RECENT = [0, 900, 3600, 21600];

export function legend(app) {
  const fill = fills(), swatch = (k, words, span) => make("td", { colspan: span }, make("span", { class: "swatch", style: { background: fill[k] } }), make("span", { class: "word" }, words));
  const row = (name, ...cells) => make("tr", {}, make("th", { scope: "row" }, name), ...cells);
  const table = make("table", { class: "triangle" }, make("tbody", {},
    row(say("legend.four"), ...[0, 1, 2, 3].map(k => swatch(k, say(`legend.class.${k}`), 1))),
    row(say("legend.two"), ...[0, 1].map(k => swatch(4 + k, say(`legend.two.${k}`), 2))),
    row(say("legend.little"), swatch(6, say("legend.one"), 4))));
  const line = (kind, key) => make("li", {}, make("span", { class: `swatch ${kind}` }), say(key));
  const parts = draw("svg", { viewBox: "0 0 32 32", class: "parts", "aria-hidden": "true" });
  SIDES.forEach(([ax, ay, bx, by], k) => parts.append(draw("polygon", { points: `16,16 ${ax * 32},${ay * 32} ${bx * 32},${by * 32}`, fill: fill[[0, 2, 1, 3][k]], stroke: "#fff" })));
  return [
    make("h2", {}, say("legend.head")), make("p", {}, say("legend.intro")), table,
    make("ul", { class: "plain" }, line("hollow", "legend.bound"), app.show.borrowed ? line("borrowed", "legend.borrowed") : null, line("nobody", "legend.nobody"), line("away", "legend.away"),
      line("ring", "legend.alert"), app.settings.overlay ? line("truth", "legend.overlay") : null),
    make("p", { class: "headings" }, parts, say("legend.heading")), make("p", {}, say("legend.worst")),
    make("h2", {}, say("legend.show")), ...shows(app),
  ];
}

function shows(app) {
  const box = name => make("label", { class: "line" }, make("input", { type: "checkbox", id: `show-${name}`, checked: app.show[name], onchange: e => app.set(name, e.target.checked) }), say(`show.${name}`));
  const choice = make("select", { id: "show-recent", onchange: e => app.set("recent", Number(e.target.value)) }, ...RECENT.map(s => make("option", { value: String(s), selected: app.show.recent === s }, say(`show.recent.${s}`))));
  return [box("bounds"), app.settings.overlay ? box("overlay") : null, box("borrowed"), make("label", { class: "line" }, say("show.recent"), choice)].filter(Boolean);
}
