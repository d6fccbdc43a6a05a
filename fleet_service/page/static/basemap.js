// The operator's own raster tiles below the cells. There are none unless the server was started
// with --base-map.
const MOST = 300;
const LEAST_PX = 128;

export class BaseMap {
  constructor({ address, zooms }, changed) {
    Object.assign(this, { address, zooms, changed, pictures: new Map() });
  }

  paint(pen, view) {
    const [least, most] = this.zooms;
    const z = Math.max(least, Math.min(most, Math.round(view.zoom)));
    const n = 2 ** z;
    const px = view.scale / n;
    const { west, east, north, south } = view.box;
    // the tile file begins at a nearer zoom, which would need hundreds of tiles
    if (px < LEAST_PX) return;
    pen.globalAlpha = 0.55; // the cells' colours must stand out
    for (let x = Math.max(0, Math.floor(west * n)); x < Math.min(n, east * n); x++)
      for (let y = Math.max(0, Math.floor(north * n)); y < Math.min(n, south * n); y++) {
        const picture = this.picture(z, x, y);
        if (picture.complete && picture.naturalWidth)
          pen.drawImage(picture, view.left(x / n), view.top(y / n), px + 0.5, px + 0.5);
      }
    pen.globalAlpha = 1;
  }

  picture(z, x, y) {
    const name = `${z}/${x}/${y}`;
    let found = this.pictures.get(name);
    if (!found) {
      found = new Image();
      found.onload = this.changed;
      found.src = this.address.replace("{z}", z).replace("{x}", x).replace("{y}", y);
      this.pictures.set(name, found);
      if (this.pictures.size > MOST) this.pictures.delete(this.pictures.keys().next().value);
    }
    return found;
  }
}
