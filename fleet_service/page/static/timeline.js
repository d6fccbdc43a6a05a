// Slider of the stored moments. Its last position is now. The shown moment is always written beside
// it.
import { make } from "./elements.js";
import { compareMoments, goToMoment } from "./moments.js";
import { clock, say, zone } from "./texts.js";

const PLAY_MS = 700;

export class Timeline {
  constructor(footer, page) {
    this.page = page;
    this.moments = [];
    this.timer = null;
    this.slider = make("input", {
      type: "range",
      id: "slider",
      min: "0",
      max: "0",
      value: "0",
      "aria-label": say("time.label"),
      oninput: () => this.chosen(),
    });
    this.shown = make("output", { id: "moment", for: "slider" });
    this.play = make(
      "button",
      { type: "button", id: "play", onclick: () => (this.timer ? this.stop() : this.start()) },
      say("time.play"),
    );
    this.compare = make(
      "button",
      {
        type: "button",
        id: "compare",
        "aria-pressed": "false",
        onclick: () => compareMoments(page, !page.state.comparing),
      },
      say("time.compare"),
    );
    this.none = make("span", { class: "note" }, say("time.none"));
    addEventListener("beforeprint", () => this.say(true)); // a printed page has no clock next to it
    addEventListener("afterprint", () => this.say());
    footer.append(this.play, this.slider, this.shown, this.compare, this.none);
    this.say();
  }

  async load() {
    const answer = await fetch("/moments");
    if (!answer.ok) return;
    const at = this.at;
    this.moments = await answer.json();
    this.slider.max = this.moments.length;
    this.put(at);
  }

  get at() {
    return this.moments[Number(this.slider.value)] ?? null;
  }

  // Show a moment, or the last stored one before it; null means now.
  put(at) {
    const found = at === null ? -1 : this.moments.findLastIndex(moment => moment <= at);
    this.slider.value = found < 0 ? this.moments.length : found;
    this.say();
  }

  say(printed = false) {
    const stamp = at => `${clock(at)} ${zone(at)}`;
    const now = printed
      ? say("time.printed", { moment: stamp(this.page.live.now()) })
      : say("time.now");
    const words = this.at === null ? now : say("time.shown", { moment: stamp(this.at) });
    this.shown.textContent = words;
    this.slider.setAttribute("aria-valuetext", words);
    const any = this.moments.length > 0;
    this.none.hidden = any;
    this.none.textContent = say(this.page.settings.archive ? "time.none.archive" : "time.none");
    for (const one of [this.play, this.slider, this.compare])
      Object.assign(one, { disabled: !any, hidden: !any });
    this.compare.textContent = say(
      this.page.state.comparing ? "time.compare.stop" : "time.compare",
    );
    this.compare.setAttribute("aria-pressed", String(this.page.state.comparing));
  }

  chosen() {
    this.say();
    return goToMoment(this.page, this.at);
  }

  start() {
    if (this.at === null) this.slider.value = 0;
    this.play.textContent = say("time.stop");
    const step = async () => {
      await this.chosen();
      if (this.at === null) {
        this.stop();
        return;
      }
      this.timer = setTimeout(() => {
        this.slider.value = Number(this.slider.value) + 1;
        step();
      }, PLAY_MS);
    };
    this.timer = -1;
    step();
  }

  stop() {
    clearTimeout(this.timer);
    this.timer = null;
    this.play.textContent = say("time.play");
  }
}
