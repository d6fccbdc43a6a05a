// State of the page: maps of now and of a past moment, alerts, roads, and the user's choices.
import { CELLS, CELL_LEVEL, cellOf, middleOf, worldX, worldY } from "./grid.js";

/** State of the page. It does not contain elements of the document. */
export class State {
  /** @param {Cells} now cells of the live map */
  constructor(now) {
    Object.assign(this, {
      now,
      past: null,
      comparing: false,
      pinned: null, // pinned: cells on the right side of a comparison
      alerts: [],
      away: [],
      areas: [],
      roads: null,
      truth: null,
      hasAlerts: false,
      isServed: null,
      route: [],
      routeFound: null,
      routeError: "",
      chosen: null,
      tab: "now",
      theme: null,
      swipe: 0.5,
    });
    this.show = {
      roads: true,
      bounds: true,
      overlay: false,
      borrowed: false,
      recent: 0,
      sound: false,
    };
  }

  /** Cells on the large map: those of the past moment, or of now. */
  get cells() {
    return this.past ?? this.now;
  }

  /** Return the name of the road near a point [deg]; "" if no road is near. */
  roadAt(longitude, latitude) {
    return this.roads?.nearest(worldX(longitude), worldY(latitude)) ?? "";
  }

  /**
   * Choose the place whose records are shown.
   * @param {number} tile number of the map tile
   * @param {number} local number of the cell within the tile
   * @param {?number} sector heading to show first; null without one
   */
  choose(tile, local, sector = null) {
    const level = this.cells.tiles.get(tile)?.block.level ?? CELL_LEVEL;
    const side = 2 ** (CELL_LEVEL - level) / CELLS;
    const { x, y } = middleOf(cellOf(tile, local));
    this.chosen = {
      tile,
      local,
      sector,
      level,
      side,
      records: this.cells.at_place(tile, local),
      x: Math.floor(x / side) * side,
      y: Math.floor(y / side) * side,
      middleX: x,
      middleY: y,
    };
  }

  /** Read the records of the chosen place again. Return true if they changed. */
  refreshChosen() {
    if (this.past || !this.chosen) return false;
    const before = JSON.stringify(this.chosen.records);
    this.chosen.records = this.cells.at_place(this.chosen.tile, this.chosen.local);
    return before !== JSON.stringify(this.chosen.records);
  }

  /**
   * Restore the state of a link: options, theme, tab and route.
   * @param {Object<string, string>} words parts of the address after "#"
   * @param {string[]} tabs names of the tabs
   */
  restore(words, tabs) {
    for (const name of ["overlay", "borrowed", "sound"]) this.show[name] = words[name] === "1";
    this.show.bounds = words.passed !== "0";
    this.show.roads = words.cells !== "1";
    this.show.recent = numberIn(words, "recent", 0);
    this.theme = words.theme ?? this.theme;
    this.now.borrowed = this.show.borrowed;
    this.tab = tabs.includes(words.tab) ? words.tab : this.tab;
    this.route = (words.route ?? "")
      .split("|")
      .map(point => point.split(",").map(Number))
      .filter(point => point.length === 2 && point.every(Number.isFinite));
  }
}

/** Return a number from the parts of a link, or `other` if it is missing or not finite. */
export const numberIn = (words, name, other) =>
  words[name] !== undefined && Number.isFinite(Number(words[name])) ? Number(words[name]) : other;
