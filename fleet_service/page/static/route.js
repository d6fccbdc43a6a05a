// A route from clicks or from a GPX file: the friction along it, its unknown share, and the safe
// speed at its worst place.
import { profile } from "./charts.js";
import { make } from "./elements.js";
import { fitTo, goTo } from "./navigation.js";
import { say } from "./texts.js";

const MOST_POINTS = 400;
const MOST_BYTES = 20e6;

export function routePanel(page) {
  const file = make("input", {
    type: "file",
    accept: ".gpx",
    id: "gpx",
    onchange: e => e.target.files[0] && readFile(page, e.target.files[0]),
  });
  const head = [
    make("h2", {}, say("route.head")),
    make("p", {}, say("route.how")),
    make("label", { class: "line", for: "gpx" }, say("route.file"), file),
    make(
      "button",
      {
        type: "button",
        id: "route-clear",
        disabled: !page.state.route.length,
        onclick: () => setRoute(page, []),
      },
      say("route.clear"),
    ),
  ];
  if (page.state.routeError)
    head.push(make("p", { class: "error", role: "alert" }, page.state.routeError));
  const found = page.state.routeFound;
  if (!found) return head;
  const share = value => Math.round(100 * value);
  const worst = found.stretches[found.worst] ?? null;
  const sight = page.settings.sights_m[0];
  return [
    ...head,
    make(
      "p",
      { id: "route-share" },
      say("route.length", {
        length: (found.length_m / 1000).toFixed(2),
        measured: share(found.share.measured),
        unknown: 100 - share(found.share.measured),
      }),
    ),
    make(
      "p",
      { id: "route-worst" },
      worst === null
        ? say("route.worst.none")
        : say("route.worst", {
            mu: worst.mu_lower.toFixed(2),
            where: (worst.from_m / 1000).toFixed(2),
            speed: Math.floor(3.6 * worst.safe_speed[sight]),
            sight,
          }),
    ),
    profile(found, page.settings.colours.slippery, one => goTo(page, one.longitude, one.latitude)),
    make("p", { class: "note" }, say("route.label")),
  ];
}

/**
 * Show another route, and the friction along it.
 * @param {Page} page the page
 * @param {number[][]} points longitude and latitude [deg] of each point; empty for no route
 * @param {string} error why there is no route
 */
export async function setRoute(page, points, error = "") {
  const { state, map, panels } = page;
  Object.assign(state, { route: points, routeFound: null, routeError: error });
  page.remember();
  map.draw();
  if (points.length > 1) {
    const { found, error: refused } = await askGrip(points);
    if (state.route === points) Object.assign(state, { routeFound: found, routeError: refused });
  }
  if (state.tab === "route") panels.refresh();
}

/** Read the route of a GPX file, and show it. */
export async function readFile(page, file) {
  const points = file.size <= MOST_BYTES ? pointsOf(await file.text()) : [];
  setRoute(page, points, points.length < 2 ? say("route.bad_file") : "");
  if (points.length > 1) fitTo(page, points);
}

export function pointsOf(text) {
  const found = new DOMParser().parseFromString(text, "application/xml");
  const all = [...found.querySelectorAll("trkpt, rtept")]
    .map(point => [Number(point.getAttribute("lon")), Number(point.getAttribute("lat"))])
    .filter(point => point.every(Number.isFinite));
  const step = Math.max(1, Math.ceil(all.length / MOST_POINTS));
  return all.filter((_, k) => k % step === 0 || k === all.length - 1);
}

/** Ask the server for the friction along a line. */
async function askGrip(points) {
  const words = points
    .map(([longitude, latitude]) => `${longitude.toFixed(7)},${latitude.toFixed(7)}`)
    .join("|");
  const answer = await fetch(`/route?${new URLSearchParams({ points: words })}`);
  return answer.ok
    ? { found: await answer.json(), error: "" }
    : { found: null, error: await answer.text() };
}
