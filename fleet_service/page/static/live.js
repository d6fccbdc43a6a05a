// What the server pushes, and whether it still does: by this page's own clock, not only by errors that a browser reports.
import { decode, fromBase64 } from "./blocks.js";
import { ago, clock, say } from "./texts.js";

const SILENT_MS = 5000, PAD = 1;  // a view's width on each side is listened to

export class Live {
  constructor({ blocks, alerts, beat, reload }) {
    Object.assign(this, { blocks, alerts, beat, reload });
    this.state = null;
    this.beaten = null;
    this.source = null;
    this.listens = null;
  }

  // Listen to what a view shows; opened anew only when it has left what is listened to.
  look(view) {
    const [west, south, east, north] = view.degrees(), old = this.listens;
    if (old && old.level === view.level && old.box[0] <= west && old.box[1] <= south && old.box[2] >= east && old.box[3] >= north) return false;
    const box = view.degrees(PAD);
    this.listens = { box, level: view.level };
    this.source?.close();
    const words = new URLSearchParams({ bbox: box.map(v => v.toFixed(5)).join(","), level: view.level });
    const source = this.source = new EventSource(`/events?${words}`);
    source.addEventListener("tiles", e => this.blocks(e.data.split("\n").flatMap(text => decode(fromBase64(text)))));
    source.addEventListener("alerts", e => this.alerts(JSON.parse(e.data)));
    source.addEventListener("reload", () => this.reload());
    source.addEventListener("open", () => this.reload());  // what was missed while it was not open
    source.addEventListener("beat", e => {
      this.state = JSON.parse(e.data);
      this.beaten = performance.now();
      this.beat(this.state);
    });
    source.addEventListener("error", () => {
      if (source.readyState === EventSource.CLOSED && this.source === source) setTimeout(() => { this.listens = null; this.look(view); }, 2000);
    });
    return true;
  }

  // Seconds since 1970 by the server, whose clock stamped the cells.
  now() {
    return this.state ? this.state.now + (performance.now() - this.beaten) / 1000 : Date.now() / 1000;
  }

  words(moment) {
    if (moment !== null) return say("live.past", { moment: clock(moment) });
    if (!this.state) return say("live.waiting");
    const silent = performance.now() - this.beaten, heard = this.state.heard;
    if (silent > SILENT_MS) return say("live.lost", { ago: ago(silent / 1000) });
    if (!heard) return say("live.never");
    const since = { ago: ago(this.now() - heard) };
    if (!this.state.router) return say("live.no_router", since);
    return this.state.served ? say("live") : say("live.no_service", since);
  }
}
