// The page: one state, one window on the world, one panel at a time.
import { alertsPanel, beep, begun } from "./alerts.js";
import { dress, moveDivider } from "./appearance.js";
import { BaseMap } from "./basemap.js";
import { Cells } from "./cells.js";
import { addControls, markTab } from "./controls.js";
import { kindOf, setColours } from "./colours.js";
import { byId, make } from "./elements.js";
import { CELLS, CELL_LEVEL, cellAt, cellOf, latitudeOf, localOfCell, longitudeOf, metresPerWorld, middleOf, tileOfCell, worldX, worldY } from "./grid.js";
import { healthPanel } from "./health.js";
import { legend } from "./legend.js";
import { Live } from "./live.js";
import { overviewPanel } from "./overview.js";
import { paint, scaleBar } from "./paint.js";
import { placePanel } from "./place.js";
import { sidewaysOf } from "./ribbons.js";
import { Roads } from "./roads.js";
import { ask, open, routePanel } from "./route.js";
import { fromHash, linkTo, sharePanel } from "./share.js";
import { stateCard } from "./states.js";
import { ago, clock, loadTexts, say, zone } from "./texts.js";
import { Timeline } from "./timeline.js";
import { VectorMap } from "./vector.js";
import { View } from "./view.js";
import { alertWords, bySeverity } from "./words.js";

const TABS = ["now", "legend", "cell", "alerts", "route", "health", "share"];
const LOOK_MS = 120, CLOCK_MS = 500, HEALTH_MS = 3000, LIST_MS = 15000, ROADS_MS = 1500, SAID_MS = 10000, NEAR_PX = 12;
const DOT = .1, DOT_ZOOM = 16, FAR = 1e-3;  // of the world: some 40 km
const WORLD = [-180, -85, 180, 85];

class App {
  constructor(settings, now) {
    Object.assign(this, { settings, now, alerts: [], route: [], routeFound: null, routeError: "", chosen: null, comparing: false, pinned: null, tab: "now", away: [], areas: [], roads: null, swipe: .5, failed: false });
    this.show = { roads: true, bounds: true, overlay: false, borrowed: false, recent: 0, sound: false };
    this.past = null;
    this.view = new View(byId("map"));
    this.view.moved = () => this.moved();
    this.view.clicked = (px, py) => this.click(px, py);
    this.base = settings.base_map ? new (settings.base_map.vector ? VectorMap : BaseMap)(settings.base_map, () => this.draw()) : null;
    this.live = new Live({ blocks: found => this.blocks(found), alerts: found => this.alerted(found), beat: state => this.beat(state), reload: () => this.reload() });
    this.timeline = new Timeline(byId("timeline"), this);
    this.moreRoads = 0;
    this.now.changed = () => this.draw();
    this.frame = this.looking = 0;
    this.started = this.asked = this.missed = false;
  }

  get cells() { return this.past ?? this.now; }  // what the large map shows: a moment, or now
  degreesOf(x, y) { return [longitudeOf(x), latitudeOf(y)]; }

  async start() {
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.addEventListener("change", () => dress(this));
    addControls(this, TABS);
    dress(this);
    this.resize();
    new ResizeObserver(() => this.resize()).observe(byId("map"));
    addEventListener("hashchange", () => this.restore(fromHash(location.hash)));
    document.addEventListener("dragover", e => e.preventDefault());
    document.addEventListener("drop", e => { e.preventDefault(); const file = e.dataTransfer.files[0]; if (file) { this.open("route"); open(this, file); } });
    byId("map").addEventListener("keydown", e => { if (e.key === "a" && this.alerts.length) this.jump(this.alerts[0]); });
    setInterval(() => this.tick(), CLOCK_MS);
    setInterval(() => ["health", "now"].includes(this.tab) && !document.activeElement?.closest("#panel > *") && this.panel(), HEALTH_MS);
    setInterval(() => { this.now.list().catch(() => {}); this.timeline.load(); this.loadAreas(); this.loadRoads(); this.tab === "alerts" && this.panel(); }, LIST_MS);
    const state = fromHash(location.hash), ofPast = state.at !== undefined || state.compare !== undefined;
    this.firstRoads = this.settings.roads ? this.loadRoads() : null;
    if (ofPast) await this.loadBeside();
    this.started = true;
    await (state.x ? this.restore(state) : this.begin());
    this.open(this.tab);
    this.tick();
    await this.look();
    if (!ofPast) await this.loadBeside();
    document.body.dataset.ready = "1";
    this.drawNow();
    if (this.missed) this.reload();
    this.panel();
  }

  // What the first picture does not need: the server computes areas and roads of its own while it could send cells.
  loadBeside() { return Promise.all([this.timeline.load(), this.loadAreas(), this.firstRoads ?? this.loadRoads(), this.settings.overlay ? this.loadTruth() : null]); }

  async restore(state) {
    const number = (name, other) => Number.isFinite(Number(state[name])) && state[name] !== undefined ? Number(state[name]) : other;
    for (const name of ["overlay", "borrowed", "sound"]) this.show[name] = state[name] === "1";
    this.show.bounds = state.passed !== "0";
    this.show.roads = state.cells !== "1";
    this.theme = state.theme ?? this.theme;
    dress(this);
    this.show.recent = number("recent", 0);
    this.now.borrowed = this.show.borrowed;
    this.tab = TABS.includes(state.tab) ? state.tab : this.tab;
    this.view.go(number("x", .5), number("y", .35), number("zoom", 3));
    this.route = (state.route ?? "").split("|").map(point => point.split(",").map(Number)).filter(point => point.length === 2 && point.every(Number.isFinite));
    if (this.route.length > 1) this.setRoute(this.route);
    if (state.at !== undefined) { this.timeline.put(number("at", null)); await this.goToMoment(this.timeline.at); }
    if (state.compare !== undefined) await this.compare(true, state.compare === "now" ? this.now : new Cells(number("compare", 0)));
    await this.look();
    if (state.cell !== undefined) this.choose(tileOfCell(number("cell", 0)), localOfCell(number("cell", 0)));
    this.open(this.tab);
  }

  roadAt(longitude, latitude) { return this.roads?.nearest(worldX(longitude), worldY(latitude)) ?? ""; }

  async loadRoads() {
    if (this.roads && !this.roads.learned) return;
    const answer = await fetch("/roads").catch(() => null);
    if (!answer?.ok) return;
    this.roads = new Roads(await answer.json());
    this.draw();
  }

  async loadAreas() {
    const answer = await fetch("/areas").catch(() => null);
    if (!answer?.ok) return;
    const before = JSON.stringify(this.areas);
    this.areas = await answer.json();
    if (this.tab === "now" && before !== JSON.stringify(this.areas)) this.panel();
  }

  showArea({ box: [west, south, east, north] }) { this.view.fit({ west: worldX(west), east: worldX(east), north: worldY(north), south: worldY(south) }); }

  showPlace(x, y) {
    this.view.go(x, y, Math.max(this.view.zoom, 18));
    this.chooseAt(x, y);
  }

  // The area with most alerts where several lie far apart, else the whole map.
  async begin() {
    const extent = this.now.extent;
    if (extent && extent.east - extent.west > FAR) await this.loadAreas();
    if (this.areas.length < 2) { await this.all(); return; }
    this.showArea(this.areas[0]);
    await this.look();
  }

  // The whole map, and what comes to it, until somebody looks elsewhere.
  async all() {
    for (let zoom = null, k = 0; k < 4 && zoom !== this.view.zoom; k++) {  // again to the cells, where only their tiles or squares were known before
      zoom = this.view.zoom;
      if (this.cells.extent) { this.view.fit(this.cells.extent); this.view.gone = false; }
      await this.look();
      if (this.view.gone) return;
    }
  }

  follow() {
    const { view, past } = this, box = view.box, extent = view.gone || past ? null : this.now.extent;
    const dot = extent && view.zoom < DOT_ZOOM && Math.max((extent.east - extent.west) / view.width, (extent.south - extent.north) / view.height) * view.scale < DOT;  // the first cells, on a map of the world
    if (dot || extent && (extent.west < box.west || extent.east > box.east || extent.north < box.north || extent.south > box.south)) this.begin();
  }

  resize() {
    if (matchMedia("print").matches) return;  // paper takes the picture of the screen
    const ratio = devicePixelRatio || 1;
    for (const id of ["beside", "divider"]) byId(id).hidden = !this.comparing;
    this.slide(this.swipe);
    let changed = false;
    for (const canvas of [byId("map"), byId("beside")]) {
      const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
      if (canvas.width === width && canvas.height === height) continue;
      changed = true;
      Object.assign(canvas, { width, height }).getContext("2d").setTransform(ratio, 0, 0, ratio, 0, 0);
    }
    if (!changed) return;
    this.view.width = byId("map").clientWidth;
    this.view.height = byId("map").clientHeight;
    this.view.covered = byId("foot").offsetHeight;
    this.moved();
  }

  slide(share) { this.swipe = moveDivider(share); }

  moved() {
    this.draw();
    clearTimeout(this.looking);
    if (this.asked) this.looking = setTimeout(() => this.look(), LOOK_MS);  // at the start it is looked anyway
  }

  async look() {
    if (!this.started) return;
    if (this.live.look(this.view)) this.draw();
    const level = this.view.level, box = this.view.box, stores = this.comparing ? [this.cells, this.pinned] : [this.cells];
    try { await Promise.all(stores.map(store => store.show(box, level))); } catch { this.note(say("error.asked")); }
    if (!this.asked && this.view.gone) this.drawNow();  // before any panel is made
    this.asked = true;
    if (this.chosen && this.chosen.level !== level) this.choose(this.chosen.tile, this.chosen.local, this.chosen.sector);
    this.remember();
    this.draw();
  }

  async reload() {
    if (!document.body.dataset.ready) { this.missed = true; return; }  // after the first picture
    await this.now.list();
    this.follow();
    this.now.generation++;
    this.now.wanted.clear();
    const box = this.view.box;
    await this.now.fetch([...this.now.tiles.keys()], this.view.level).catch(() => this.note(say("error.asked")));
    await this.now.show(box, this.view.level).catch(() => {});
    this.draw();
  }

  blocks(found) {
    if (this.show.borrowed) { this.now.fetch(found.map(block => block.tile), this.view.level); return; }
    const missing = found.filter(block => block.level === this.view.level && !this.now.take(block)).map(block => block.tile);
    if (missing.length) this.now.fetch(missing, this.view.level).catch(() => {});
    this.follow();
    this.refreshPlace();
    this.draw();
    if (!this.moreRoads && (this.roads?.learned ?? true)) this.moreRoads = setTimeout(() => { this.moreRoads = 0; this.loadRoads(); this.loadAreas(); }, ROADS_MS);
    document.body.dataset.pushed = Number(document.body.dataset.pushed || 0) + found.length;
  }

  refreshPlace() {
    if (this.past || !this.chosen) return;
    const before = JSON.stringify(this.chosen.records);
    this.chosen.records = this.cells.at_place(this.chosen.tile, this.chosen.local);
    if (this.tab === "cell" && before !== JSON.stringify(this.chosen.records)) this.panel();
  }

  alerted(found) {
    const fresh = this.heardAlerts ? begun(this.alerts, found) : [];
    this.heardAlerts = true;
    this.alerts = bySeverity(found);
    for (const alert of fresh) {
      this.note(say("alerts.new", { words: alertWords(alert, this.roadAt(alert.longitude, alert.latitude)) }));
      if (this.show.sound) beep();
    }
    byId("tab-alerts").textContent = found.length ? `${say("tab.alerts")} (${found.length})` : say("tab.alerts");
    document.body.dataset.alerts = found.length;
    if (this.tab === "alerts" || this.tab === "now") this.panel();
    this.draw();
  }

  beat(state) {
    this.away = state.away.length || state.served ? state.away : [{ box: WORLD }];  // nobody ever answered: no emptiness
    const words = byId("away"), since = Math.min(...state.away.map(one => one.since));
    words.hidden = !state.away.length;
    if (state.away.length) words.textContent = say("away", { count: state.away.length, ago: ago(state.now - since) });
    this.tick();
    if (this.tab === "now" && this.served !== state.served) this.panel();  // its words say whether a service answers
    this.served = state.served;
    this.draw();
  }

  tick() {
    const words = this.live.words(this.past?.at ?? null), place = byId("live");
    if (place.textContent !== words) place.textContent = words;
    stateCard(this);
    place.dataset.state = words === say("live") ? "live" : "late";
  }

  note(words) { byId("said").textContent = words; clearTimeout(this.saying); if (words) this.saying = setTimeout(() => this.note(""), SAID_MS); }

  // Not before the first cells were asked for: an empty picture is painted as slowly as a full one.
  draw() {
    if (this.frame || !this.asked) return;
    this.frame = requestAnimationFrame(() => { this.frame = 0; this.drawNow(); });
  }

  drawNow() {
    const extra = {
      base: this.base, roads: this.show.roads && !this.show.borrowed ? this.roads : null, away: this.past ? [] : this.away, alerts: this.past ? [] : this.alerts, route: this.route, bounds: this.show.bounds,
      oldest: this.show.recent ? (this.cells.at ?? this.live.now()) - this.show.recent : 0, truth: this.show.overlay ? this.truth : null, chosen: this.chosen,
    };
    const { drawn, asRoads } = paint(byId("map").getContext("2d"), this.view, this.cells, extra);
    this.asRoads = asRoads;
    if (this.comparing) this.drawBeside(extra);
    scaleBar(byId("scale"), this.view, say);
    Object.assign(document.body.dataset, { drawn: drawn.reduce((a, b) => a + b), kinds: drawn.join(","), level: this.view.level });
  }

  drawBeside(extra) {
    const now = this.pinned.at === null;
    paint(byId("beside").getContext("2d"), this.view, this.pinned, { ...extra, away: now ? this.away : [], alerts: now ? this.alerts : [] });
    for (const [id, at] of [["moment-left", this.cells.at], ["moment-right", this.pinned.at]]) byId(id).textContent = at === null ? say("time.now") : `${clock(at)} ${zone(at)}`;
  }

  click(px, py) {
    const at = this.view.place(px, py);
    if (this.tab === "route") { this.setRoute([...this.route, this.degreesOf(at.x, at.y)]); return; }
    this.chooseAt(at.x, at.y);
  }

  chooseAt(x, y) {
    const { tile, local, sector = null } = this.asRoads ? this.roads.meantAt(this.cells, x, y, sidewaysOf(this.view), NEAR_PX * metresPerWorld(y) / this.view.scale) : cellAt(x, y);
    this.choose(tile, local, sector);
    this.open("cell");
  }

  choose(tile, local, sector = null) {
    const level = this.cells.tiles.get(tile)?.block.level ?? CELL_LEVEL, side = 2 ** (CELL_LEVEL - level) / CELLS;
    const { x, y } = middleOf(cellOf(tile, local));
    this.chosen = { tile, local, sector, x, y, side, level, records: this.cells.at_place(tile, local) };
    this.chosen.x = Math.floor(x / side) * side;
    this.chosen.y = Math.floor(y / side) * side;
    Object.assign(this.chosen, { middleX: x, middleY: y });
    this.remember();
    this.draw();
    if (this.tab === "cell") this.panel();
  }

  open(name) {
    this.tab = name;
    markTab(TABS, name);
    this.remember();
    this.panel();
  }

  async panel() {
    const name = this.tab, made = await ({
      now: () => overviewPanel(this), legend: () => legend(this), cell: () => placePanel(this, this.chosen), alerts: () => alertsPanel(this), route: () => routePanel(this),
      health: () => healthPanel(this), share: () => sharePanel(this),
    })[name]();
    const held = byId("panel"), same = held.childNodes.length === made.length && made.every((one, k) => one.isEqualNode(held.childNodes[k]));
    if (name === this.tab && !same) held.replaceChildren(...made);
  }

  set(name, value) {
    this.show[name] = value;
    if (name === "borrowed") { this.now.borrowed = value; this.reload(); this.panel(); }
    if (name === "sound" && value) beep();
    this.remember();
    this.draw();
  }

  jump(alert) {
    this.goTo(alert.longitude, alert.latitude);
    byId("map").focus();
  }

  goTo(longitude, latitude) { this.view.go(worldX(longitude), worldY(latitude), Math.max(this.view.zoom, 17.5)); }

  fitTo(points) {
    const xs = points.map(point => worldX(point[0])), ys = points.map(point => worldY(point[1]));
    this.view.fit({ west: Math.min(...xs), east: Math.max(...xs), north: Math.min(...ys), south: Math.max(...ys) });
  }

  async setRoute(points, error = "") {
    Object.assign(this, { route: points, routeFound: null, routeError: error });
    this.remember();
    this.draw();
    if (points.length > 1) {
      const { found, error: refused } = await ask(points);
      if (this.route === points) Object.assign(this, { routeFound: found, routeError: refused });
    }
    if (this.tab === "route") this.panel();
  }

  async goToMoment(at) {
    const before = this.past;
    const past = at === null ? null : new Cells(at);
    if (past) {
      past.changed = () => this.draw();
      await past.list();
      await past.show(this.view.box, this.view.level);
    }
    if (this.past !== before) return;  // another was chosen meanwhile
    this.past = past;
    if (this.chosen) this.choose(this.chosen.tile, this.chosen.local, this.chosen.sector);
    this.tick();
    this.remember();
    this.drawNow();
    document.body.dataset.at = at ?? "now";
  }

  // The moment that is shown now stays on the right, and the slider moves what is on the left.
  async compare(on, pinned = this.cells) {
    Object.assign(this, { comparing: on, pinned: on ? pinned : null });
    pinned.changed = () => this.draw();
    for (const id of ["moment-left", "moment-right"]) byId(id).hidden = !on;
    if (on && pinned.at !== null) await pinned.list();
    this.resize();
    this.timeline.say();
    this.look();
  }

  async loadTruth() {
    const told = await (await fetch("/overlay")).json();
    if (!told) { setTimeout(() => this.loadTruth(), LIST_MS); return; }
    const steps = this.settings.mu_steps;
    this.truth = told.cell.map((cell, k) => {
      const { x, y } = middleOf(Number(cell)), mu = Math.round(told.mu[k] * steps);
      return { x: x - .5 / CELLS, y: y - .5 / CELLS, sector: told.sector[k], kind: kindOf(1, mu, mu, mu) };
    });
    this.draw();
  }

  remember() { if (this.view.gone || this.cells.known.size) history.replaceState(null, "", linkTo(this)); }
}

const now = new Cells();
const [settings] = await Promise.all([fetch("/settings").then(answer => answer.json()), loadTexts(), now.list()]);
document.title = say("title");
setColours(settings);
const app = new App(settings, now);
globalThis.gripmap = app;  // for a person at the console
await app.start();
