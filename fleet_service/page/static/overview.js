// The first panel: what is slippery now, how much is unknown, and where data exist.
import { shortList } from "./alerts.js";
import { byId, make } from "./elements.js";
import { showPlace } from "./navigation.js";
import { areaList } from "./search.js";
import { sharesOf, slipperyStretches } from "./stretches.js";
import { say } from "./texts.js";
import { stretchWords } from "./words.js";

const MOST = 3;
const MOST_STRETCHES = 6;

export function overviewPanel(page) {
  const alerts = page.state.alerts.length;
  const more =
    alerts > MOST
      ? make(
          "button",
          { type: "button", onclick: () => page.panels.open("alerts") },
          say("overview.more", { count: alerts }),
        )
      : null;
  const late = byId("live").dataset.state === "late" && page.live.state?.heard;
  const past =
    page.state.past || late
      ? make("p", { class: "note" }, say(page.state.past ? "alerts.none.past" : "overview.late"))
      : null;
  return [
    make("h2", {}, say(alerts ? "overview.alerts" : "overview.none", { count: alerts })),
    past,
    ...(alerts
      ? [shortList(page, MOST), more]
      : [
          make(
            "p",
            { class: "quiet" },
            say(
              page.state.areas.length
                ? "overview.no_alert"
                : page.live.state?.served
                  ? "overview.nothing"
                  : "overview.unheard",
            ),
          ),
        ]),
    ...(page.map.asRoads && !page.state.past && !page.state.comparing ? inView(page) : []),
    make("h2", {}, say("areas.head")),
    ...areaList(page),
  ].filter(Boolean);
}

// Summary of the roads in view: slippery stretches without an alert, and the unknown share.
function inView(page) {
  const found = slipperyStretches(page.state.roads, page.map.view.box, page.state.alerts);
  const shares = sharesOf(page.state.roads, page.map.view.box);
  const more = found.length - MOST_STRETCHES;
  const item = one =>
    make(
      "li",
      {},
      make(
        "a",
        {
          class: "stretch",
          href: "#stretch",
          onclick: e => {
            e.preventDefault();
            showPlace(page, one.x, one.y);
          },
        },
        make("span", { class: `swatch k${one.kind}` }),
        make(
          "span",
          {},
          make("strong", {}, stretchWords(one)),
          make(
            "small",
            {},
            say("overview.stretch", {
              what: say(`legend.short.${one.kind}`),
              length: Math.round(one.length_m),
              percent: Math.min(99, Math.floor((100 * one.slippery) / page.settings.share_steps)),
              vehicles: one.vehicles,
            }),
          ),
        ),
      ),
    );
  return [
    ...(shares
      ? [make("h2", {}, say("overview.known")), ...knownBar(shares, page.state.roads.learned)]
      : []),
    ...(found.length
      ? [
          make("h2", {}, say("overview.stretches")),
          make("ul", { class: "stretches" }, ...found.slice(0, MOST_STRETCHES).map(item)),
          more > 0
            ? make("p", { class: "note" }, say("overview.stretches.more", { count: more }))
            : null,
        ]
      : []),
  ];
}

function knownBar(shares, learned) {
  const parts = ["slippery", "grip", "unknown", "never"].filter(name => shares[name] > 0);
  const percent = name => Math.round((100 * shares[name]) / shares.whole);
  return [
    make(
      "div",
      { class: "known", "aria-hidden": "true" },
      ...parts.map(name =>
        make("span", { class: `part-${name}`, style: { flexGrow: shares[name] } }),
      ),
    ),
    make(
      "ul",
      { class: "plain known-words" },
      ...parts.map(name =>
        make(
          "li",
          {},
          make("span", { class: `swatch part-${name}` }),
          make(
            "span",
            { "data-share": name },
            say(`overview.share.${name}`, { percent: percent(name) }),
          ),
        ),
      ),
    ),
    make(
      "p",
      { class: "note" },
      say(learned ? "overview.known.driven" : "overview.known.note", {
        length: (shares.whole / 1000).toFixed(1),
      }),
    ),
  ];
}
