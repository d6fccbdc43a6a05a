// Events that the server pushes. The page's own clock detects silence, because browsers do not
// report every lost connection.
import { decode, fromBase64 } from "./blocks.js";
import { ago, clock, say } from "./texts.js";

const SILENT_MS = 5000;
const PAD = 1; // a margin of one view width on each side is subscribed, too

export class Live {
  constructor({ blocks, alerts, beat, reload }) {
    Object.assign(this, { blocks, alerts, beat, reload });
    this.state = null;
    this.beaten = null;
    this.source = null;
    this.listens = null;
  }

  // Subscribe to the shown area. The subscription is renewed only when the view has left the
  // subscribed area.
  look(view) {
    const [west, south, east, north] = view.degrees();
    const old = this.listens;
    if (
      old &&
      old.level === view.level &&
      old.box[0] <= west &&
      old.box[1] <= south &&
      old.box[2] >= east &&
      old.box[3] >= north
    )
      return false;
    const box = view.degrees(PAD);
    this.listens = { box, level: view.level };
    this.source?.close();
    const words = new URLSearchParams({
      bbox: box.map(v => v.toFixed(5)).join(","),
      level: view.level,
    });
    const source = (this.source = new EventSource(`/events?${words}`));
    source.addEventListener("tiles", e =>
      this.blocks(e.data.split("\n").flatMap(text => decode(fromBase64(text)))),
    );
    source.addEventListener("alerts", e => this.alerts(JSON.parse(e.data)));
    source.addEventListener("reload", () => this.reload());
    source.addEventListener("open", () => this.reload()); // changes before the opening were missed
    source.addEventListener("beat", e => {
      this.state = JSON.parse(e.data);
      this.beaten = performance.now();
      this.beat(this.state);
    });
    source.addEventListener("error", () => {
      if (source.readyState === EventSource.CLOSED && this.source === source)
        setTimeout(() => {
          this.listens = null;
          this.look(view);
        }, 2000);
    });
    return true;
  }

  // Current time by the server's clock, which stamped the cells [s since 1970].
  now() {
    return this.state
      ? this.state.now + (performance.now() - this.beaten) / 1000
      : Date.now() / 1000;
  }

  words(moment) {
    if (moment !== null) return say("live.past", { moment: clock(moment) });
    if (!this.state) return say("live.waiting");
    const silent = performance.now() - this.beaten;
    const heard = this.state.heard;
    if (silent > SILENT_MS) return say("live.lost", { ago: ago(silent / 1000) });
    if (!heard) return say("live.never");
    const since = { ago: ago(this.now() - heard) };
    if (!this.state.router) return say("live.no_router", since);
    return this.state.served ? say("live") : say("live.no_service", since);
  }
}
