// Plain texts for places and alerts, with road names if they are known.
import { latitudeOf, longitudeOf } from "./grid.js";
import { say } from "./texts.js";

const BOUNDS = { east: "eastbound", north: "northbound", west: "westbound", south: "southbound" };

const degrees = value => `${Math.abs(value).toFixed(5)}°`;

export const coordinates = (longitude, latitude) =>
  `${degrees(latitude)} ${latitude < 0 ? "S" : "N"}, ` +
  `${degrees(longitude)} ${longitude < 0 ? "W" : "E"}`;

// Sort alerts by danger: ice before snow, then by certainty, then by length.
export const bySeverity = alerts =>
  [...alerts].sort(
    (a, b) =>
      surfaceRank(a.mu) - surfaceRank(b.mu) ||
      b.p_slippery - a.p_slippery ||
      b.length_m - a.length_m,
  );

// Join words: "a", "a and b", "a, b and c".
const listed = words =>
  [words.slice(0, -1).join(", "), words.at(-1)].filter(Boolean).join(` ${say("and")} `);

const surfaceRank = mu => (mu < 0.2 ? 0 : 1);

export function alertWords(alert, road) {
  const what = say(alert.mu < 0.2 ? "alert.ice" : "alert.slippery");
  const ways =
    alert.headings.length >= 4
      ? say("alert.all_ways")
      : listed(alert.headings.map(one => say(`alert.${BOUNDS[one]}`)));
  return say(road ? "alert.on_road" : "alert.on_no_road", {
    what,
    road,
    ways,
    place: coordinates(alert.longitude, alert.latitude),
  });
}

export function stretchWords({ name, heading, kind, x, y }) {
  return say(name ? "alert.on_road" : "alert.on_no_road", {
    what: say(kind === 0 ? "alert.ice" : "alert.slippery"),
    road: name,
    ways: say(`alert.${BOUNDS[heading]}`),
    place: coordinates(longitudeOf(x), latitudeOf(y)),
  });
}

// Return the certainty in percent; it is never rounded up to 100.
export const certainty = share =>
  share > 0.995 ? say("percent.over", { n: 99 }) : String(Math.floor(share * 100));
