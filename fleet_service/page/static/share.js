// The state of the page as a link, and the visible map as a file.
import { numbers } from "./place.js";
import { byId, make } from "./elements.js";
import { HEADINGS, cellOf, latitudeOf, longitudeOf } from "./grid.js";
import { SIDES } from "./paint.js";
import { say } from "./texts.js";

// Return the part after "#" of a link to the current state.
export function linkTo(page) {
  const {
    map: { view },
    state: { show, chosen },
  } = page;
  const words = new URLSearchParams();
  const state = {
    x: view.x.toFixed(8),
    y: view.y.toFixed(8),
    zoom: view.zoom.toFixed(2),
    at: page.state.past?.at,
    compare: page.state.comparing ? (page.state.pinned.at ?? "now") : null,
    tab: page.state.tab,
    cell: chosen ? cellOf(chosen.tile, chosen.local) : null,
    passed: show.bounds ? null : "0",
    cells: show.roads ? null : "1",
    theme: page.state.theme,
    overlay: show.overlay,
    borrowed: show.borrowed,
    recent: show.recent || null,
    sound: show.sound,
    route: page.state.route.map(point => point.map(v => v.toFixed(6)).join(",")).join("|"),
  };
  for (const [name, value] of Object.entries(state))
    if (value !== null && value !== undefined && value !== "" && value !== false)
      words.set(name, value === true ? "1" : String(value));
  return `#${words}`;
}

export const fromHash = text => Object.fromEntries(new URLSearchParams(text.replace(/^#/, "")));

export function sharePanel(page) {
  const link = make("input", {
    type: "text",
    readonly: "",
    id: "link",
    value: location.href,
    "aria-label": say("share.link"),
  });
  const copy = make(
    "button",
    {
      type: "button",
      onclick: async e => {
        link.select();
        await navigator.clipboard?.writeText(link.value);
        e.target.textContent = say("share.copied");
      },
    },
    say("share.copy"),
  );
  const save = (id, name, kind, write) =>
    make(
      "button",
      { type: "button", id, onclick: () => download(name, kind, write(seen(page))) },
      say(`share.${id}`),
    );
  return [
    make("h2", {}, say("share.head")),
    make("label", { class: "line", for: "link" }, say("share.link")),
    link,
    make(
      "div",
      { class: "buttons" },
      copy,
      save("geojson", "gripmap.geojson", "application/geo+json", geojson),
      save("csv", "gripmap.csv", "text/csv", csv),
      make("button", { type: "button", onclick: () => print() }, say("share.print")),
    ),
    make("p", { class: "note" }, say("share.zoomed_out")),
  ];
}

// Return the places in view as rows. A lower bound has no mu.
function seen(page) {
  const box = page.map.view.box;
  const rows = [];
  for (const tile of page.state.cells.tiles.values()) {
    const { rows: records, x, y, side } = tile.parts;
    for (let k = 0; k < records.count; k++) {
      if (x[k] > box.east || x[k] + side < box.west || y[k] > box.south || y[k] + side < box.north)
        continue;
      const raw = Object.fromEntries(
        ["last", "mu", "lower", "upper", "slippery", "basis", "vehicles", "unknown"].map(name => [
          name,
          records[name][k],
        ]),
      );
      const cell = numbers(raw, page.settings);
      const level = tile.block.level;
      const corner = (cx, cy) => [longitudeOf(x[k] + cx * side), latitudeOf(y[k] + cy * side)];
      const whole = level === 21;
      const sector = records.place[k] & 3;
      const [ax, ay, bx, by] = SIDES[sector];
      const middle = corner(0.5, 0.5);
      const ring = whole
        ? [middle, corner(ax, ay), corner(bx, by), middle]
        : [
            [0, 1],
            [1, 1],
            [1, 0],
            [0, 0],
            [0, 1],
          ].map(([cx, cy]) => corner(cx, cy));
      rows.push({
        ring,
        cell: whole ? cellOf(tile.block.tile, records.place[k] >> 2) : null,
        sector: whole ? sector : null,
        heading: whole ? HEADINGS[sector] : "all",
        mu: cell.mu,
        mu_lower: cell.lower,
        mu_upper: cell.upper,
        p_slippery: cell.slippery,
        basis: cell.basis,
        vehicles: cell.vehicles,
        last_time: new Date(cell.last * 1000).toISOString(),
        latitude: middle[1],
        longitude: middle[0],
        zoom: level,
        unknown_share: cell.unknown,
      });
    }
  }
  return rows;
}

const short = value => (typeof value === "number" ? Number(value.toFixed(7)) : value);

function geojson(rows) {
  return JSON.stringify({
    type: "FeatureCollection",
    features: rows.map(({ ring, ...rest }) => ({
      type: "Feature",
      geometry: { type: "Polygon", coordinates: [ring.map(point => point.map(short))] },
      properties: Object.fromEntries(
        Object.entries(rest).map(([name, value]) => [name, short(value)]),
      ),
    })),
  });
}

function csv(rows) {
  if (!rows.length) return "";
  const plain = rows.map(({ ring, ...rest }) => rest);
  return (
    [
      Object.keys(plain[0]).join(","),
      ...plain.map(row =>
        Object.values(row)
          .map(value => (value === null ? "" : short(value)))
          .join(","),
      ),
    ].join("\r\n") + "\r\n"
  );
}

function download(name, kind, text) {
  const address = URL.createObjectURL(new Blob([text], { type: kind }));
  const link = make("a", { href: address, download: name });
  byId("panel").append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}
