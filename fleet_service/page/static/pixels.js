// Draw squares as numbers in memory. With a canvas call for each of 20 000 squares, a browser
// without a graphics card draws about eight pictures per second. A single picture in memory reaches
// the display's frame rate.
import { BORROWED } from "./blocks.js";
import { HOLLOW, fills, groundColour, inks } from "./colours.js";

const LEAST_PX = 3;
const DASH_PX = 2;
// [px] shift with which neighbouring squares, also of two tiles, round their common edge alike
const TIE = 1e-4;

const word = colour => {
  // colour "#rrggbb" as the four bytes of a pixel
  const [r, g, b] = [1, 3, 5].map(k => parseInt(colour.slice(k, k + 2), 16));
  return new Uint32Array(new Uint8Array([r, g, b, 255]).buffer)[0];
};

export class Pixels {
  constructor() {
    this.canvas = document.createElement("canvas");
  }

  // Allocate the memory of a picture of this size.
  reserve(width, height) {
    if (this.canvas.width === width && this.canvas.height === height && this.image) return;
    Object.assign(this.canvas, { width, height });
    this.image = new ImageData(Math.max(1, width), Math.max(1, height));
    this.points = new Uint32Array(this.image.data.buffer);
    this.points.fill(1); // write the memory now, because the system allocates it at the first write
  }

  // Begin a picture of a size in pixels; `ratio` is pixels per CSS pixel. `opaque` is true if
  // nothing is drawn below it.
  begin(width, height, ratio, opaque) {
    this.reserve(width, height);
    Object.assign(this, { width, height, ratio, opaque, line: Math.max(1, Math.round(ratio)) });
    this.ground = word(groundColour());
    this.inks = fills().map(word);
    this.bound = word(inks().bound);
    this.dash = word(inks().text);
    this.points.fill(opaque ? this.ground : 0);
  }

  show(pen) {
    if (this.opaque) {
      pen.putImageData(this.image, 0, 0);
      return;
    }
    this.canvas.getContext("2d").putImageData(this.image, 0, 0);
    pen.drawImage(this.canvas, 0, 0, this.width / this.ratio, this.height / this.ratio);
  }

  // Draw a tile's squares, first the hollow ones. Add the numbers of squares in view to `drawn`, by
  // kind.
  squares(view, { rows, column, row, kind, side, west, north, steps }, passes, drawn) {
    const px = side * view.scale * this.ratio;
    const least = Math.round(LEAST_PX * this.ratio);
    const edges = first => {
      // begin and end of each column or row; neighbours meet without a gap
      const from = new Int32Array(steps);
      const to = new Int32Array(steps);
      for (let k = 0; k < steps; k++) {
        from[k] = Math.round(first + k * px + TIE);
        to[k] = Math.max(Math.round(first + (k + 1) * px + TIE), from[k] + least);
      }
      return [from, to];
    };
    const [lefts, rights] = edges(view.left(west) * this.ratio);
    const [tops, bottoms] = edges(view.top(north) * this.ratio);
    for (let hollow = 1; hollow >= 0; hollow--) {
      for (let k = 0; k < rows.count; k++) {
        const what = kind[k];
        if ((what === HOLLOW) !== (hollow === 1) || (passes && !passes(rows, k))) continue;
        const left = lefts[column[k]];
        const right = rights[column[k]];
        const top = tops[row[k]];
        const bottom = bottoms[row[k]];
        if (right <= 0 || bottom <= 0 || left >= this.width || top >= this.height) continue;
        drawn[what]++;
        this.fill(left, top, right, bottom, hollow ? this.bound : this.inks[what]);
        if (hollow)
          this.fill(
            left + this.line,
            top + this.line,
            right - this.line,
            bottom - this.line,
            this.ground,
          );
        else if (rows.basis[k] === BORROWED) this.dashed(left, top, right, bottom);
        else if (rows.unknown[k]) this.notch(left, top, right, bottom, rows.unknown[k] / 254);
      }
    }
  }

  // Draw a hole in the middle of a square, whose area is the unknown share: at least a pixel, but
  // never the whole square.
  notch(left, top, right, bottom, share) {
    const size = length =>
      Math.max(1, Math.min(length - 2, Math.round(length * Math.sqrt(share) * 0.8)));
    const width = size(right - left);
    const height = size(bottom - top);
    const x = left + ((right - left - width) >> 1);
    const y = top + ((bottom - top - height) >> 1);
    this.fill(x, y, x + width, y + height, this.ground);
  }

  // Fill a rectangle, clipped at the picture's edges.
  fill(left, top, right, bottom, ink) {
    const { points, width } = this;
    const from = Math.max(0, left);
    const to = Math.min(width, right);
    const last = Math.min(this.height, bottom);
    for (let y = Math.max(0, top); y < last; y++)
      for (let at = y * width + from, end = y * width + to; at < end; at++) points[at] = ink;
  }

  // Draw a dashed line around a rectangle.
  dashed(left, top, right, bottom) {
    const { line } = this;
    const step = Math.round(DASH_PX * this.ratio);
    for (let x = left; x < right; x += 2 * step)
      for (const y of [top, bottom - line])
        this.fill(x, y, Math.min(right, x + step), y + line, this.dash);
    for (let y = top; y < bottom; y += 2 * step)
      for (const x of [left, right - line])
        this.fill(x, y, x + line, Math.min(bottom, y + step), this.dash);
  }
}
