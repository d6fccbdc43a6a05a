// State of the services: by their own reports, and by what a reader receives.
import { make } from "./elements.js";
import { ago, say } from "./texts.js";

export async function healthPanel(page) {
  const answer = await fetch("/health");
  const told = await answer.json();
  const line = text => make("li", {}, text);
  const regionState = one =>
    one.served
      ? say("health.region.served")
      : say("health.region.away", { ago: ago(page.live.now() - one.since) });
  const regions = told.regions.map(one => line(`${one.region}: ${regionState(one)}`));
  return [
    make("h2", {}, say("health.head")),
    make(
      "ul",
      { class: "plain" },
      line(
        say("health.router", {
          state: say(told.router ? "health.router.yes" : "health.router.no"),
        }),
      ),
      line(
        told.names.length
          ? say("health.services", { names: told.names.join(", ") })
          : say("health.services.hidden"),
      ),
      line(say("health.vehicles", { count: told.vehicles })),
      line(say("health.watchers", { count: told.watchers, reloads: told.reloads })),
    ),
    ...told.services.map(service),
    told.services.length ? null : make("p", { class: "note" }, say("health.no_metrics")),
    make("h3", {}, say("health.regions")),
    make("ul", { class: "plain" }, ...regions),
  ].filter(Boolean);
}

function service(one) {
  if (!one.answers)
    return make("p", { class: "error" }, say("health.silent", { address: one.address }));
  const rows = [
    ["health.rate", one.per_second === null ? "…" : one.per_second.toFixed(1)],
    [
      "health.lag",
      one.report_lag_seconds === null ? "–" : `${one.report_lag_seconds.toFixed(1)} s`,
    ],
    ["health.cells", one.cells],
    ["health.alerts", one.alerts],
  ];
  const refused = Object.entries(one.refused).filter(([, n]) => n);
  return make(
    "div",
    {},
    make("h3", {}, one.address),
    make(
      "table",
      {},
      make(
        "tbody",
        {},
        ...rows.map(([name, value]) =>
          make("tr", {}, make("th", { scope: "row" }, say(name)), make("td", {}, String(value))),
        ),
      ),
    ),
    make("h4", {}, say("health.refused")),
    make(
      "ul",
      { class: "plain" },
      ...(refused.length
        ? refused.map(([reason, n]) => make("li", {}, `${reason}: ${n}`))
        : [make("li", {}, say("health.refused.none"))]),
    ),
  );
}
