// Alerts: which stand, why, for how long; a sound when one begins, if it was asked for.
import { make } from "./elements.js";
import { ago, say } from "./texts.js";

export function alertsPanel(app) {
  const sound = make("label", { class: "line" }, make("input", { type: "checkbox", id: "sound", checked: app.show.sound, onchange: e => app.set("sound", e.target.checked) }), say("alerts.sound"));
  const head = [make("h2", {}, say("alerts.head")), sound];
  if (app.cells.at !== null) head.push(make("p", { class: "note" }, say("alerts.none.past")));
  if (!app.alerts.length) return [...head, make("p", {}, say("alerts.none"))];
  return [...head, make("ol", { class: "alerts" }, ...app.alerts.map(alert => item(app, alert)))];
}

function item(app, alert) {
  const values = { length: Math.round(alert.length_m), direction: alert.direction, headings: alert.headings.join(", "), mu: alert.mu.toFixed(2), lower: alert.mu_lower.toFixed(2), upper: alert.mu_upper.toFixed(2), vehicles: alert.vehicles };
  return make("li", { "data-alert": alert.id },
    make("strong", {}, say("alerts.line", values)), make("span", {}, say("alerts.grip", values)),
    make("span", {}, say("alerts.since", { ago: ago(app.live.now() - Date.parse(alert.since) / 1000), reason: alert.reason })),
    make("button", { type: "button", onclick: () => app.jump(alert) }, say("alerts.jump")));
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
