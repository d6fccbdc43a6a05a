// List of the active alerts: where each one is, how certain, and for how long.
import { make } from "./elements.js";
import { jumpTo } from "./navigation.js";
import { setOption } from "./options.js";
import { ago, say } from "./texts.js";
import { alertWords, bySeverity, certainty, coordinates } from "./words.js";

export function alertsPanel(page) {
  const sound = make(
    "label",
    { class: "line" },
    make("input", {
      type: "checkbox",
      id: "sound",
      checked: page.state.show.sound,
      onchange: e => setOption(page, "sound", e.target.checked),
    }),
    say("alerts.sound"),
  );
  const head = [make("h2", {}, say("alerts.head"))];
  if (page.state.cells.at !== null)
    head.push(make("p", { class: "note" }, say("alerts.none.past")));
  if (!page.state.alerts.length)
    return [...head, make("p", { class: "quiet" }, say("alerts.none")), sound];
  return [...head, alertList(page), sound];
}

export const alertList = page =>
  make(
    "ol",
    { class: "alerts" },
    ...bySeverity(page.state.alerts).map((alert, k) => item(page, alert, k + 1)),
  );

// The short list of alerts. Each alert has two lines, so that other content fits on a small screen.
export const shortList = (page, most) =>
  make(
    "ol",
    { class: "alerts" },
    ...bySeverity(page.state.alerts)
      .slice(0, most)
      .map((alert, k) =>
        make(
          "li",
          { "data-alert": alert.id, class: surface(alert) },
          badge(k + 1),
          make(
            "a",
            {
              href: "#alert",
              onclick: e => {
                e.preventDefault();
                jumpTo(page, alert);
              },
            },
            make("strong", {}, wordsOf(page, alert)),
            make("span", {}, say("alerts.short", valuesOf(page, alert))),
          ),
        ),
      ),
  );

const surface = alert => (alert.mu < 0.2 ? "ice" : "snow");
const badge = number => make("span", { class: "number", "aria-hidden": "true" }, String(number));
const wordsOf = (page, alert) =>
  alertWords(alert, page.state.roadAt(alert.longitude, alert.latitude));

function valuesOf(page, alert) {
  return {
    length: Math.round(alert.length_m),
    mu: alert.mu.toFixed(2),
    lower: alert.mu_lower.toFixed(2),
    upper: alert.mu_upper.toFixed(2),
    vehicles: alert.vehicles,
    percent: certainty(alert.p_slippery),
    ago: ago(page.live.now() - Date.parse(alert.since) / 1000),
  };
}

function item(page, alert, number) {
  const values = valuesOf(page, alert);
  return make(
    "li",
    { "data-alert": alert.id, class: surface(alert) },
    badge(number),
    make(
      "div",
      {},
      make("strong", {}, wordsOf(page, alert)),
      make("span", {}, say("alerts.line", values)),
      make("span", { class: "note" }, say("alerts.grip", values)),
      make(
        "div",
        { class: "line" },
        make("button", { type: "button", onclick: () => jumpTo(page, alert) }, say("alerts.jump")),
        make("span", { class: "note place" }, coordinates(alert.longitude, alert.latitude)),
      ),
    ),
  );
}

// Return the alerts of `after` that `before` does not contain.
export function begun(before, after) {
  const known = new Set(before.map(alert => alert.id));
  return after.filter(alert => !known.has(alert.id));
}
