// The large map: two canvases, the view, and the order of drawing.
import { moveDivider } from "./appearance.js";
import { BaseMap } from "./basemap.js";
import { byId } from "./elements.js";
import { cellAt, degreesOf, metresPerWorld } from "./grid.js";
import { paint, reservePicture, scaleBar } from "./paint.js";
import { sidewaysOf } from "./ribbons.js";
import { setRoute } from "./route.js";
import { clock, say, zone } from "./texts.js";
import { VectorMap } from "./vector.js";
import { View } from "./view.js";

const LOOK_MS = 120;
const NEAR_PX = 12;

/** Map of the page. It draws the state, and requests the cells that come into view. */
export class MapWindow {
  /** @param {Page} page the page, whose state is drawn */
  constructor(page) {
    Object.assign(this, { page, frame: 0, waiting: 0, asked: false, asRoads: false });
    this.view = new View(byId("map"));
    this.view.moved = () => this.moved();
    this.view.clicked = (px, py) => this.click(px, py);
    const base = page.settings.base_map;
    this.base = base ? new (base.vector ? VectorMap : BaseMap)(base, () => this.draw()) : null;
  }

  /** Give the canvases the size of the window; draw if it changed. */
  resize() {
    if (matchMedia("print").matches) return; // a printed page shows the picture of the screen
    const ratio = devicePixelRatio || 1;
    const state = this.page.state;
    for (const id of ["beside", "divider"]) byId(id).hidden = !state.comparing;
    this.slide(state.swipe);
    let changed = false;
    for (const canvas of [byId("map"), byId("beside")]) {
      if (canvas.hidden) continue;
      const width = Math.round(canvas.clientWidth * ratio);
      const height = Math.round(canvas.clientHeight * ratio);
      if (canvas.width === width && canvas.height === height) continue;
      changed = true;
      Object.assign(canvas, { width, height })
        .getContext("2d")
        .setTransform(ratio, 0, 0, ratio, 0, 0);
    }
    this.view.covered = byId("foot").offsetHeight;
    if (!changed) return;
    this.view.width = byId("map").clientWidth;
    this.view.height = byId("map").clientHeight;
    this.moved();
  }

  /** Move the divider of a comparison to a share of the width, from 0 to 1. */
  slide(share) {
    this.page.state.swipe = moveDivider(share);
  }

  /** Draw after the view has moved, and request missing cells when it rests. */
  moved() {
    this.draw();
    clearTimeout(this.waiting);
    // the start requests the cells itself
    if (this.asked) this.waiting = setTimeout(() => this.look(), LOOK_MS);
  }

  /** Draw a place (coordinates from 0 to 1) as soon as its cells have arrived. */
  async drawFirst(x, y, zoom) {
    this.view.go(x, y, zoom);
    reservePicture(byId("map"));
    await this.page.state.now.show(this.view.box, this.view.level).catch(() => {});
    this.drawNow();
  }

  /** Request the cells in view and their changes, and draw them when they have arrived. */
  async look() {
    const { page } = this;
    const { state } = page;
    if (!page.started) return;
    const level = this.view.level;
    const box = this.view.box;
    const stores = state.comparing ? [state.cells, state.pinned] : [state.cells];
    const shown = Promise.all(stores.map(store => store.show(box, level)));
    if (page.live.look(this.view)) this.draw();
    try {
      await shown;
    } catch {
      page.panels.note(say("error.asked"));
    }
    if (!this.asked && this.view.gone) this.drawNow(); // draw before any panel is made
    this.asked = true;
    const { chosen } = state;
    if (chosen && chosen.level !== level) page.choose(chosen.tile, chosen.local, chosen.sector);
    page.remember();
    this.draw();
  }

  /**
   * Draw in the next frame, but not before the first cells were requested: drawing an empty picture
   * takes as long as a full one.
   */
  draw() {
    if (this.frame || !this.asked) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      this.drawNow();
    });
  }

  /** Draw the state at once, and write the numbers of drawn places into the document's data. */
  drawNow() {
    const { state, live } = this.page;
    const { show, cells } = state;
    const extra = {
      base: this.base,
      roads: show.roads && !show.borrowed ? state.roads : null,
      away: state.past ? [] : state.away,
      alerts: state.past ? [] : state.alerts,
      route: state.route,
      bounds: show.bounds,
      oldest: show.recent ? (cells.at ?? live.now()) - show.recent : 0,
      truth: show.overlay ? state.truth : null,
      chosen: state.chosen,
    };
    const { drawn, asRoads } = paint(byId("map").getContext("2d"), this.view, cells, extra);
    this.asRoads = asRoads;
    if (state.comparing) drawBeside(this.view, state, extra);
    scaleBar(byId("scale"), this.view, say);
    Object.assign(document.body.dataset, {
      drawn: drawn.reduce((a, b) => a + b),
      kinds: drawn.join(","),
      level: this.view.level,
    });
  }

  /** Add a point of the route, or choose the place under a point of the screen [px]. */
  click(px, py) {
    const at = this.view.place(px, py);
    const { state } = this.page;
    if (state.tab === "route") setRoute(this.page, [...state.route, degreesOf(at.x, at.y)]);
    else this.chooseAt(at.x, at.y);
  }

  /**
   * Choose the place at a point (coordinates from 0 to 1): the ribbon drawn near it, or else the
   * cell.
   */
  chooseAt(x, y) {
    const { page } = this;
    const { roads, cells } = page.state;
    const near = (NEAR_PX * metresPerWorld(y)) / this.view.scale;
    const {
      tile,
      local,
      sector = null,
    } = this.asRoads ? roads.meantAt(cells, x, y, sidewaysOf(this.view), near) : cellAt(x, y);
    page.choose(tile, local, sector);
    page.panels.open("cell");
  }
}

// Draw the right side of a comparison.
function drawBeside(view, state, extra) {
  const isNow = state.pinned.at === null;
  paint(byId("beside").getContext("2d"), view, state.pinned, {
    ...extra,
    away: isNow ? state.away : [],
    alerts: isNow ? state.alerts : [],
  });
  for (const [id, at] of [
    ["moment-left", state.cells.at],
    ["moment-right", state.pinned.at],
  ])
    byId(id).textContent = at === null ? say("time.now") : `${clock(at)} ${zone(at)}`;
}
