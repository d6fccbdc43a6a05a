// The first panel: what is slippery now, and where there are data.
import { alertList } from "./alerts.js";
import { make } from "./elements.js";
import { areaList } from "./search.js";
import { say } from "./texts.js";

const MOST = 5;

export function overviewPanel(app) {
  const alerts = app.alerts.length, more = alerts > MOST ? make("button", { type: "button", onclick: () => app.open("alerts") }, say("overview.more", { count: alerts })) : null;
  return [
    make("h2", {}, say("overview.alerts", { count: alerts })),
    ...(alerts ? [alertList(app, MOST), more] : [make("p", { class: "quiet" }, say(app.areas.length ? "overview.no_alert" : "overview.nothing"))]),
    make("h2", {}, say("areas.head")), ...areaList(app),
  ].filter(Boolean);
}
