// The page: its parts, their start, and what concerns all of them.
import { applyTheme, dress, onDeviceTheme } from "./appearance.js";
import { Cells } from "./cells.js";
import { setColours } from "./colours.js";
import { addControls } from "./controls.js";
import { byId } from "./elements.js";
import { localOfCell, tileOfCell } from "./grid.js";
import { Live } from "./live.js";
import { MapWindow } from "./map.js";
import { compareMoments, goToMoment } from "./moments.js";
import { jumpTo, showFirst } from "./navigation.js";
import { Panels, TABS } from "./panels.js";
import { readFile, setRoute } from "./route.js";
import { fromHash, linkTo } from "./share.js";
import { State, numberIn } from "./state.js";
import { loadTexts, say } from "./texts.js";
import { Timeline } from "./timeline.js";
import { Updates } from "./updates.js";
import { START, boxOf, levelOf } from "./view.js";

// As in style.css: width of the panel beside the map, or share of a phone's screen that the panel
// below it takes.
const PHONE_PX = 800;
const SIDE_PX = 400;
const SHEET = 0.44;
const BARE_MS = 300; // longest time for which the first picture may delay the buttons

/** The page: state, map, panels, updates from the server, and timeline. */
class Page {
  /**
   * @param {Object} settings constants and colours from /settings
   * @param {Cells} now cells of the live map
   */
  constructor(settings, now) {
    this.settings = settings;
    this.started = false;
    this.state = new State(now);
    this.panels = new Panels(this);
    this.updates = new Updates(this);
    this.live = new Live({
      blocks: found => this.updates.blocks(found),
      alerts: found => this.updates.alerts(found),
      beat: told => this.updates.beat(told),
      reload: () => this.updates.reload(),
    });
    this.map = new MapWindow(this);
    this.timeline = new Timeline(byId("timeline"), this);
    now.changed = () => this.map.draw();
  }

  /** Show the first picture, and then load the parts that it does not need. */
  async start() {
    const { map, panels, state, updates } = this;
    const words = fromHash(location.hash);
    const isPast = words.at !== undefined || words.compare !== undefined;
    updates.firstRoads = this.settings.roads ? updates.loadRoads() : null;
    if (words.x && !isPast) await this.drawFirst(words);
    addControls(this, TABS);
    dress(this);
    map.resize();
    this.listen();
    panels.keepFresh();
    if (isPast) await updates.loadBeside();
    this.started = true;
    await (words.x ? this.restore(words) : showFirst(this));
    panels.open(state.tab);
    panels.tick();
    await map.look();
    if (!isPast) await updates.loadBeside();
    document.body.dataset.ready = "1";
    map.drawNow();
    if (updates.missed) updates.reload();
    panels.refresh();
  }

  /**
   * Draw the place of a link before the buttons and panels exist, unless its cells take too long.
   */
  async drawFirst(words) {
    this.state.restore(words, TABS);
    applyTheme(this);
    this.map.resize();
    await Promise.race([
      this.map.drawFirst(...placeOf(words)),
      new Promise(resolve => setTimeout(resolve, BARE_MS)),
    ]);
  }

  /**
   * Listen to window events: size, theme, links, dropped files, and the key that goes to the first
   * alert.
   */
  listen() {
    onDeviceTheme(() => dress(this));
    new ResizeObserver(() => this.map.resize()).observe(byId("map"));
    addEventListener("hashchange", () => this.restore(fromHash(location.hash)));
    document.addEventListener("dragover", e => e.preventDefault());
    document.addEventListener("drop", e => {
      e.preventDefault();
      const file = e.dataTransfer.files[0];
      if (file) {
        this.panels.open("route");
        readFile(this, file);
      }
    });
    byId("map").addEventListener("keydown", e => {
      if (e.key === "a" && this.state.alerts.length) jumpTo(this, this.state.alerts[0]);
    });
  }

  /** Restore the state of a link, given as the parts of the address after "#". */
  async restore(words) {
    const { state, map, timeline, panels } = this;
    state.restore(words, TABS);
    dress(this);
    map.view.go(...placeOf(words));
    if (state.route.length > 1) setRoute(this, state.route);
    if (words.at !== undefined) {
      timeline.put(numberIn(words, "at", null));
      await goToMoment(this, timeline.at);
    }
    if (words.compare !== undefined)
      await compareMoments(
        this,
        true,
        words.compare === "now" ? state.now : new Cells(numberIn(words, "compare", 0)),
      );
    await map.look();
    if (words.cell !== undefined) {
      const cell = numberIn(words, "cell", 0);
      this.choose(tileOfCell(cell), localOfCell(cell));
    }
    panels.open(state.tab);
  }

  /** Choose a place (see State.choose) and show it. */
  choose(tile, local, sector = null) {
    this.state.choose(tile, local, sector);
    this.remember();
    this.map.draw();
    if (this.state.tab === "cell") this.panels.refresh();
  }

  /** Write the state into the address, so that the address is a link to this view. */
  remember() {
    if (this.map.view.gone || this.state.cells.known.size)
      history.replaceState(null, "", linkTo(this));
  }
}

// Return the place and zoom of a link.
const placeOf = words => ["x", "y", "zoom"].map(name => numberIn(words, name, START[name]));

// Request the cells of a link before the map has a size; they arrive while the page is set up.
// Cells that the panel will cover are not requested.
function askEarly(now, words) {
  if (!words.x || [words.at, words.compare, words.borrowed].some(one => one !== undefined)) return;
  const [x, y, zoom] = placeOf(words);
  const isPhone = innerWidth <= PHONE_PX;
  const width = isPhone ? innerWidth : innerWidth - SIDE_PX;
  const height = isPhone ? innerHeight * (1 - SHEET) : innerHeight;
  now.show(boxOf({ x, y, zoom, width, height }), levelOf(zoom)).catch(() => {});
}

const now = new Cells();
const listed = now.list();
listed.then(
  () => askEarly(now, fromHash(location.hash)),
  () => {},
);
const [settings] = await Promise.all([
  fetch("/settings").then(answer => answer.json()),
  loadTexts(),
  listed,
]);
document.title = say("title");
setColours(settings);
const page = new Page(settings, now);
globalThis.gripmap = page; // for use in the browser's console
await page.start();
