// The view: its position and size, and its control by mouse, touch and keys.
import { CELL_LEVEL, TILE_LEVEL, latitudeOf, longitudeOf } from "./grid.js";

/** Position and zoom at which the view begins. */
export const START = { x: 0.5, y: 0.35, zoom: 3 };

const LEAST_ZOOM = 2;
const MOST_ZOOM = 21;
const TILE_PX = 256;
const TURN = 1.25;
const STEP_PX = 60;
const CONTROLS_PX = 56;

/** Return the box that a window of a size [px] shows around a place, in coordinates from 0 to 1. */
export function boxOf({ x, y, zoom, width, height }) {
  const scale = TILE_PX * 2 ** zoom;
  const w = width / 2 / scale;
  const h = height / 2 / scale;
  return { west: x - w, east: x + w, north: y - h, south: y + h };
}

/**
 * Return the finest level at which squares have at least four pixels. This is the cell level for
 * near zooms.
 */
export const levelOf = zoom =>
  Math.max(TILE_LEVEL, Math.min(CELL_LEVEL, zoom >= 14.7 ? CELL_LEVEL : Math.floor(zoom) + 6));

/** The visible part of the world. */
export class View {
  constructor(canvas) {
    Object.assign(this, {
      canvas,
      ...START,
      gone: false,
      width: 1,
      height: 1,
      covered: 0,
      moved: () => {},
      clicked: () => {},
    });
    this.fingers = new Map();
    this.listen();
  }

  get scale() {
    return TILE_PX * 2 ** this.zoom;
  }
  get box() {
    return boxOf(this);
  }
  get level() {
    return levelOf(this.zoom);
  }
  degrees(pad = 0) {
    const b = this.box;
    const w = (b.east - b.west) * pad;
    const h = (b.south - b.north) * pad;
    const bound = v => Math.min(1, Math.max(0, v));
    return [
      longitudeOf(bound(b.west - w)),
      latitudeOf(bound(b.south + h)),
      longitudeOf(bound(b.east + w)),
      latitudeOf(bound(b.north - h)),
    ];
  }
  left(x) {
    return (x - this.x) * this.scale + this.width / 2;
  }
  top(y) {
    return (y - this.y) * this.scale + this.height / 2;
  }
  place(px, py) {
    return {
      x: this.x + (px - this.width / 2) / this.scale,
      y: this.y + (py - this.height / 2) / this.scale,
    };
  }

  go(x, y, zoom = this.zoom) {
    this.gone = true; // the user or a command has moved the view
    this.zoom = Math.min(MOST_ZOOM, Math.max(LEAST_ZOOM, zoom));
    this.x = Math.min(1, Math.max(0, x));
    this.y = Math.min(1, Math.max(0, y));
    this.moved();
  }

  // Fit a box into the part of the window that no legend, time bar or button covers.
  fit({ west, east, north, south }) {
    const high = Math.max(this.height - this.covered, this.height / 2);
    const wide = this.width - CONTROLS_PX;
    const fits = Math.min(wide / Math.max(east - west, 1e-6), high / Math.max(south - north, 1e-6));
    const zoom = Math.min(Math.log2((0.85 * fits) / TILE_PX), 18);
    this.go(
      (west + east) / 2 + CONTROLS_PX / 2 / (TILE_PX * 2 ** zoom),
      (north + south) / 2 + (this.height - high) / 2 / (TILE_PX * 2 ** zoom),
      zoom,
    );
  }

  turn(by, px = this.width / 2, py = this.height / 2) {
    const held = this.place(px, py);
    this.zoom = Math.min(MOST_ZOOM, Math.max(LEAST_ZOOM, this.zoom + Math.log2(by)));
    const now = this.place(px, py);
    this.go(this.x + held.x - now.x, this.y + held.y - now.y);
  }

  shift(dx, dy) {
    this.go(this.x - dx / this.scale, this.y - dy / this.scale);
  }

  listen() {
    const { canvas, fingers } = this;
    let travelled = 0;
    canvas.addEventListener("pointerdown", e => {
      if (!fingers.size) travelled = 0;
      fingers.set(e.pointerId, [e.offsetX, e.offsetY]);
      canvas.setPointerCapture(e.pointerId);
    });
    canvas.addEventListener("pointerup", e => {
      const alone = fingers.size === 1;
      fingers.delete(e.pointerId);
      if (alone && travelled < 6) this.clicked(e.offsetX, e.offsetY);
    });
    canvas.addEventListener("pointercancel", e => fingers.delete(e.pointerId));
    canvas.addEventListener("pointermove", e => {
      const before = fingers.get(e.pointerId);
      const now = [e.offsetX, e.offsetY];
      if (!before) return;
      const other = [...fingers].find(([id]) => id !== e.pointerId)?.[1];
      travelled += Math.hypot(now[0] - before[0], now[1] - before[1]);
      fingers.set(e.pointerId, now);
      if (other) {
        const apart = point => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
        this.turn(apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      } else this.shift(now[0] - before[0], now[1] - before[1]);
    });
    canvas.addEventListener(
      "wheel",
      e => {
        e.preventDefault();
        this.turn(TURN ** (-e.deltaY / 100), e.offsetX, e.offsetY);
      },
      { passive: false },
    );
    canvas.addEventListener("keydown", e => {
      const moves = {
        ArrowLeft: [STEP_PX, 0],
        ArrowRight: [-STEP_PX, 0],
        ArrowUp: [0, STEP_PX],
        ArrowDown: [0, -STEP_PX],
      };
      if (moves[e.key]) this.shift(...moves[e.key]);
      else if (e.key === "+" || e.key === "=") this.turn(2 ** 0.5);
      else if (e.key === "-") this.turn(2 ** -0.5);
      else if (e.key === "Enter") this.clicked(this.width / 2, this.height / 2);
      else return;
      e.preventDefault();
    });
  }
}
