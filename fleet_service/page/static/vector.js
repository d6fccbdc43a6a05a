// Vector base map: Mapbox Vector Tiles 2.1, decoded once, stored as paths, and drawn in a light or
// a dark style. The layers and classes are those of OpenMapTiles and of Protomaps.
import { inks } from "./colours.js";
import { metresPerWorld } from "./grid.js";

const MOST = 120;
const LEAST_PX = 160;
const EXTENT = 4096;
const BUILDINGS_ZOOM = 15;
const LABEL_PX = 6.2;
const WIDTHS = {
  motorway: 15,
  trunk: 13,
  primary: 11,
  secondary: 10,
  tertiary: 9,
  minor: 8,
  service: 4,
  path: 2,
};
const CLASSES = {
  highway: "motorway",
  major_road: "primary",
  medium_road: "secondary",
  minor_road: "minor",
  residential: "minor",
  unclassified: "minor",
  street: "minor",
  street_limited: "minor",
  living_street: "minor",
  pedestrian: "path",
  footway: "path",
  cycleway: "path",
  track: "path",
  other: "path",
};

export function decodeTile(buffer) {
  const bytes = new Uint8Array(buffer);
  const words = new TextDecoder();
  const layers = {};
  const reader = (at, end) => ({
    at,
    end,
    varint() {
      let value = 0;
      let scale = 1;
      let byte;
      do {
        byte = bytes[this.at++];
        value += (byte & 127) * scale;
        scale *= 128;
      } while (byte & 128);
      return value;
    },
    part() {
      const size = this.varint();
      const from = this.at;
      this.at += size;
      return [from, this.at];
    },
    skip(wire) {
      if (wire === 0) this.varint();
      else if (wire === 2) this.part();
      else this.at += wire === 1 ? 8 : 4;
    },
  });
  const each = (from, to, take) => {
    const r = reader(from, to);
    while (r.at < r.end) {
      const tag = r.varint();
      if (!take(tag >> 3, tag & 7, r)) r.skip(tag & 7);
    }
  };
  const text = ([from, to]) => words.decode(bytes.subarray(from, to));
  const valueOf = (from, to) => {
    let found = null;
    each(from, to, (field, wire, r) => {
      if (field === 1) found = text(r.part());
      else if (field === 2) {
        found = new DataView(buffer, r.at, 4).getFloat32(0, true);
        r.at += 4;
      } else if (field === 3) {
        found = new DataView(buffer, r.at, 8).getFloat64(0, true);
        r.at += 8;
      } else if (wire === 0) {
        const n = r.varint();
        found = field === 6 ? (n % 2 ? -(n + 1) / 2 : n / 2) : n;
      } else return false;
      return true;
    });
    return found;
  };
  const numbers = ([from, to]) => {
    const r = reader(from, to);
    const all = [];
    while (r.at < to) all.push(r.varint());
    return all;
  };
  each(0, bytes.length, (field, wire, r) => {
    if (field !== 3 || wire !== 2) return false;
    const layer = { name: "", extent: EXTENT, features: [] };
    const keys = [];
    const values = [];
    const raw = [];
    each(...r.part(), (f, w, s) => {
      if (f === 1) layer.name = text(s.part());
      else if (f === 2) raw.push(s.part());
      else if (f === 3) keys.push(text(s.part()));
      else if (f === 4) values.push(valueOf(...s.part()));
      else if (f === 5) layer.extent = s.varint();
      else return false;
      return true;
    });
    for (const span of raw) {
      const feature = { kind: 0, tags: {}, parts: [] };
      let tags = [];
      let commands = [];
      each(...span, (f, w, s) => {
        if (f === 2) tags = numbers(s.part());
        else if (f === 3) feature.kind = s.varint();
        else if (f === 4) commands = numbers(s.part());
        else return false;
        return true;
      });
      for (let k = 0; k + 1 < tags.length; k += 2)
        feature.tags[keys[tags[k]]] = values[tags[k + 1]];
      feature.parts = partsOf(commands);
      layer.features.push(feature);
    }
    layers[layer.name] = layer;
    return true;
  });
  return layers;
}

function partsOf(commands) {
  const parts = [];
  const zigzag = n => (n % 2 ? -(n + 1) / 2 : n / 2);
  let x = 0;
  let y = 0;
  let part = null;
  for (let k = 0; k < commands.length;) {
    const order = commands[k] & 7;
    const count = commands[k++] >> 3;
    if (order === 7) {
      part?.push(part[0]);
      continue;
    }
    for (let i = 0; i < count; i++) {
      x += zigzag(commands[k++]);
      y += zigzag(commands[k++]);
      if (order === 1) parts.push((part = []));
      part.push([x, y]);
    }
  }
  return parts;
}

// Return the paths of a tile by what they show, and its labels. Coordinates are in [0, 1] of the
// tile.
function ready(layers, language) {
  const areas = { park: new Path2D(), water: new Path2D(), building: new Path2D() };
  const ways = new Map();
  const labels = [];
  const add = (path, parts, extent) =>
    parts.forEach(part =>
      part.forEach(([x, y], k) =>
        k ? path.lineTo(x / extent, y / extent) : path.moveTo(x / extent, y / extent),
      ),
    );
  const nameOf = tags => tags[`name:${language}`] ?? tags["name:latin"] ?? tags.name ?? "";
  for (const { name: layer, extent, features } of Object.values(layers))
    for (const { kind, tags, parts } of features) {
      if (kind === 3) {
        const what = /water|ocean/.test(layer)
          ? "water"
          : /building/.test(layer)
            ? "building"
            : /park|land/.test(layer) &&
                !/residential|industrial|commercial/.test(tags.class ?? tags.kind ?? "") &&
                layer !== "earth"
              ? "park"
              : null;
        if (what) add(areas[what], parts, extent);
      } else if (kind === 2 && /transportation|road/.test(layer)) {
        const given = tags.class ?? tags.kind ?? "minor";
        const what = CLASSES[given] ?? (given in WIDTHS ? given : "path");
        const name = nameOf(tags);
        if (layer !== "transportation_name") {
          if (!ways.has(what)) ways.set(what, new Path2D());
          add(ways.get(what), parts, extent);
        }
        if (name)
          for (const part of parts)
            labels.push({ name, along: part.map(([x, y]) => [x / extent, y / extent]) });
      } else if (kind === 1 && /place/.test(layer))
        labels.push({
          name: nameOf(tags),
          at: [parts[0][0][0] / extent, parts[0][0][1] / extent],
          size:
            { city: 17, town: 15, village: 13 }[tags.class ?? tags.kind_detail ?? tags.kind] ?? 12,
        });
      else if (kind === 1 && nameOf(tags) && /water|poi|park/.test(layer))
        labels.push({
          name: nameOf(tags),
          at: [parts[0][0][0] / extent, parts[0][0][1] / extent],
          size: 12,
          quiet: true,
        });
    }
  return { areas, ways, labels };
}

export class VectorMap {
  constructor({ address, zooms, attribution }, changed, language = document.documentElement.lang) {
    Object.assign(this, { address, zooms, changed, attribution, language, tiles: new Map() });
  }

  seen(view) {
    const [least, most] = this.zooms;
    const z = Math.max(least, Math.min(most, Math.floor(view.zoom)));
    const n = 2 ** z;
    const px = view.scale / n;
    const { west, east, north, south } = view.box;
    const found = [];
    if (px < LEAST_PX) return found;
    for (let x = Math.max(0, Math.floor(west * n)); x < Math.min(n, east * n); x++)
      for (let y = Math.max(0, Math.floor(north * n)); y < Math.min(n, south * n); y++) {
        const tile = this.tile(z, x, y);
        if (tile) found.push({ tile, left: view.left(x / n), top: view.top(y / n), px });
      }
    return found;
  }

  paint(pen, view) {
    const ink = inks();
    const metre = view.scale / metresPerWorld(view.y);
    const seen = this.seen(view);
    const each = draw => {
      for (const { tile, left, top, px } of seen) {
        pen.save();
        pen.translate(left, top);
        pen.scale(px, px);
        draw(tile, px);
        pen.restore();
      }
    };
    each(({ areas }) => {
      pen.fillStyle = ink.park;
      pen.fill(areas.park, "evenodd");
      pen.fillStyle = ink.water;
      pen.fill(areas.water, "evenodd");
    });
    if (view.zoom >= BUILDINGS_ZOOM)
      each(({ areas }, px) => {
        pen.fillStyle = ink.building;
        pen.fill(areas.building, "evenodd");
        pen.strokeStyle = ink.edge;
        pen.lineWidth = 0.7 / px;
        pen.stroke(areas.building);
      });
    pen.lineJoin = pen.lineCap = "round";
    for (const [more, colour] of [
      [2, ink.edge],
      [0, ink.road],
    ])
      for (const what of Object.keys(WIDTHS).reverse())
        each(({ ways }, px) => {
          const path = ways.get(what);
          if (!path) return;
          pen.lineWidth = (Math.max(what === "path" ? 0.8 : 1.6, WIDTHS[what] * metre) + more) / px;
          pen.strokeStyle = colour;
          pen.stroke(path);
        });
    pen.lineCap = "butt";
  }

  // Draw names on top of everything else, without overlaps.
  label(pen, view, placed) {
    const ink = inks();
    const said = new Map();
    for (const { tile, left, top, px } of this.seen(view))
      for (const label of tile.labels)
        if (label.at)
          write(
            pen,
            ink,
            label.name,
            left + label.at[0] * px,
            top + label.at[1] * px,
            0,
            label.size,
            placed,
            view,
            label.quiet,
          );
        else street(pen, ink, label, left, top, px, placed, view, said);
  }

  tile(z, x, y) {
    const name = `${z}/${x}/${y}`;
    const found = this.tiles.get(name);
    if (found !== undefined) return found;
    this.tiles.set(name, null);
    if (this.tiles.size > MOST) this.tiles.delete(this.tiles.keys().next().value);
    fetch(this.address.replace("{z}", z).replace("{x}", x).replace("{y}", y))
      .then(answer => (answer.status === 200 ? answer.arrayBuffer() : null))
      .then(buffer => {
        if (buffer) {
          this.tiles.set(name, ready(decodeTile(buffer), this.language));
          this.changed();
        }
      })
      .catch(() => this.tiles.delete(name));
    return null;
  }
}

// Draw a name along a line, if the line is straight enough.
function street(pen, ink, { name, along }, left, top, px, placed, view, said) {
  const half = (name.length * LABEL_PX) / 2 + 6;
  const points = along.map(([x, y]) => [left + x * px, top + y * px]);
  const run = [0];
  for (let k = 1; k < points.length; k++)
    run.push(
      run[k - 1] + Math.hypot(points[k][0] - points[k - 1][0], points[k][1] - points[k - 1][1]),
    );
  const at = far => {
    let k = 1;
    while (k < run.length - 1 && run[k] < far) k++;
    const share = (far - run[k - 1]) / (run[k] - run[k - 1] || 1);
    return [0, 1].map(j => points[k - 1][j] + share * (points[k][j] - points[k - 1][j]));
  };
  const inside = ([x, y]) => x > 30 && y > 20 && x < view.width - 30 && y < view.height - 20;
  for (const side of [1, -1])
    for (const share of [0.5, 0.35, 0.65, 0.2, 0.8]) {
      const far = run.at(-1) * share;
      if (far < half || run.at(-1) - far < half || (said.get(name) ?? 0) > 0) continue;
      const [a, b, middle] = [at(far - half), at(far + half), at(far)];
      const chord = Math.hypot(b[0] - a[0], b[1] - a[1]);
      if (chord < 1.93 * half || !inside(middle)) continue;
      const off = side * Math.max(13, (6.5 * view.scale) / metresPerWorld(view.y));
      if (writeBeside(pen, ink, name, middle, a, b, off, 12, placed, view)) said.set(name, 1);
    }
}

// Write a name `off` pixels beside the point `at`, along the line from `a` to `b`, and upright.
export function writeBeside(pen, ink, name, at, a, b, off, size, placed, view) {
  const turn = Math.atan2(b[1] - a[1], b[0] - a[0]);
  const flat = Math.abs(turn) > Math.PI / 2 ? turn + Math.PI : turn;
  const x = at[0] + Math.sin(flat) * off;
  const y = at[1] - Math.cos(flat) * off;
  return write(pen, ink, name, x, y, flat, size, placed, view);
}

function write(pen, ink, name, x, y, turn, size, placed, view, quiet = false) {
  pen.font = `${quiet ? "italic 400" : size > 13 ? "700" : "600"} ${size}px system-ui, sans-serif`;
  const wide = pen.measureText(name).width / 2 + 4;
  const high = size * 0.7;
  const half = [
    Math.abs(Math.cos(turn)) * wide + Math.abs(Math.sin(turn)) * high,
    Math.abs(Math.sin(turn)) * wide + Math.abs(Math.cos(turn)) * high,
  ];
  if (
    placed.some(
      ([px, py, pw, ph]) => Math.abs(px - x) < pw + half[0] && Math.abs(py - y) < ph + half[1],
    )
  )
    return false;
  placed.push([x, y, ...half]);
  pen.save();
  pen.translate(x, y);
  pen.rotate(turn);
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.lineJoin = "round";
  pen.lineWidth = 3.5;
  pen.strokeStyle = ink.halo;
  pen.strokeText(name, 0, 0);
  pen.fillStyle = quiet ? ink.soft : ink.text;
  pen.fillText(name, 0, 0);
  pen.restore();
  return true;
}
