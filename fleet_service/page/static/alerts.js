// Alerts: which stand, where in plain words, how sure, for how long; a sound when one begins, if it was asked for.
import { make } from "./elements.js";
import { ago, say } from "./texts.js";
import { alertWords, bySeverity, certainty, coordinates } from "./words.js";

export function alertsPanel(app) {
  const sound = make("label", { class: "line" }, make("input", { type: "checkbox", id: "sound", checked: app.show.sound, onchange: e => app.set("sound", e.target.checked) }), say("alerts.sound"));
  const head = [make("h2", {}, say("alerts.head"))];
  if (app.cells.at !== null) head.push(make("p", { class: "note" }, say("alerts.none.past")));
  if (!app.alerts.length) return [...head, make("p", { class: "quiet" }, say("alerts.none")), sound];
  return [...head, alertList(app), sound];
}

export const alertList = app => make("ol", { class: "alerts" }, ...bySeverity(app.alerts).map((alert, k) => item(app, alert, k + 1)));

// Two lines each, so that more than alerts fits on a small screen.
export const shortList = (app, most) => make("ol", { class: "alerts" }, ...bySeverity(app.alerts).slice(0, most).map((alert, k) => make("li", { "data-alert": alert.id, class: surface(alert) }, badge(k + 1),
  make("a", { href: "#alert", onclick: e => { e.preventDefault(); app.jump(alert); } }, make("strong", {}, wordsOf(app, alert)), make("span", {}, say("alerts.short", valuesOf(app, alert)))))));

const surface = alert => alert.mu < .2 ? "ice" : "snow", badge = number => make("span", { class: "number", "aria-hidden": "true" }, String(number));
const wordsOf = (app, alert) => alertWords(alert, app.roadAt(alert.longitude, alert.latitude));

function valuesOf(app, alert) {
  return { length: Math.round(alert.length_m), mu: alert.mu.toFixed(2), lower: alert.mu_lower.toFixed(2), upper: alert.mu_upper.toFixed(2), vehicles: alert.vehicles, percent: certainty(alert.p_slippery), ago: ago(app.live.now() - Date.parse(alert.since) / 1000) };
}

function item(app, alert, number) {
  const values = valuesOf(app, alert);
  return make("li", { "data-alert": alert.id, class: surface(alert) }, badge(number),
    make("div", {}, make("strong", {}, wordsOf(app, alert)), make("span", {}, say("alerts.line", values)), make("span", { class: "note" }, say("alerts.grip", values)),
      make("div", { class: "line" }, make("button", { type: "button", onclick: () => app.jump(alert) }, say("alerts.jump")), make("span", { class: "note place" }, coordinates(alert.longitude, alert.latitude)))));
}

// Those of `after` that were not there before.
export function begun(before, after) {
  const known = new Set(before.map(alert => alert.id));
  return after.filter(alert => !known.has(alert.id));
}

let hearing = null;
export function beep() {
  hearing ??= new AudioContext();
  const tone = hearing.createOscillator(), volume = hearing.createGain();
  tone.frequency.value = 740;
  volume.gain.setValueAtTime(.15, hearing.currentTime);
  volume.gain.exponentialRampToValueAtTime(.001, hearing.currentTime + .5);
  tone.connect(volume).connect(hearing.destination);
  tone.start();
  tone.stop(hearing.currentTime + .5);
}
