// The sound of an alarm, by Web Audio. Browsers let a page sound only after a person has touched it.

import { keep, recall } from "./keep.js";

const REPEAT_S = 6; // of an alarm that is wrong, as long as it lasts
const TONE_S = 0.18;
const LOUD = 0.4;
const TUNES = { doubtful: [520, 660], wrong: [988, 740, 988, 740], test: [660] }; // [Hz]

export class Siren {
  constructor(button) {
    this.button = button;
    this.muted = recall("sound") === "off";
    this.context = null;
    this.heard = new Set(); // alarms that lasted at the last message
    this.lasting = false; // whether one of them is wrong
    this.last = -Infinity;
    this.played = 0;
    for (const kind of ["pointerup", "keydown"]) {
      window.addEventListener(kind, (event) => { if (!button.contains(event.target)) this.unlock(); });
    }
    button.addEventListener("click", () => (this.muted || this.ready ? this.toggle() : this.unlock("test")));
    setInterval(() => this.repeat(), 1000);
    this.show();
  }

  get ready() { return this.context?.state === "running"; }

  async unlock(tune = null) {
    if (this.muted || this.ready || !window.AudioContext) return;
    if (!this.context) {
      this.context = new AudioContext();
      this.context.addEventListener("statechange", () => this.show());
    }
    await this.context.resume().catch(() => {}); // a browser that wants another kind of touch
    this.show();
    if (tune) this.play(tune);
  }

  toggle() {
    this.muted = !this.muted;
    keep("sound", this.muted ? "off" : "on");
    this.show();
    if (!this.muted && this.ready) this.play("test");
    else this.unlock("test");
  }

  // Alarms that last now, each by what stays the same of it, and its severity.
  tell(alarms) {
    const fresh = alarms.filter(([name]) => !this.heard.has(name));
    this.heard = new Set(alarms.map(([name]) => name));
    this.lasting = alarms.some(([, severity]) => severity === "wrong");
    if (fresh.length) this.play(fresh.some(([, severity]) => severity === "wrong") ? "wrong" : "doubtful");
  }

  repeat() {
    if (this.lasting && performance.now() / 1000 - this.last >= REPEAT_S) this.play("wrong");
  }

  play(tune) {
    if (this.muted || !this.ready) return;
    this.last = performance.now() / 1000;
    this.played += 1;
    TUNES[tune].forEach((pitch, k) => {
      const [begin, tone, volume] = [this.context.currentTime + k * TONE_S, this.context.createOscillator(), this.context.createGain()];
      tone.frequency.value = pitch;
      volume.gain.setValueAtTime(0, begin);
      volume.gain.linearRampToValueAtTime(LOUD, begin + 0.02);
      volume.gain.setValueAtTime(LOUD, begin + TONE_S - 0.04);
      volume.gain.linearRampToValueAtTime(0, begin + TONE_S - 0.01);
      tone.connect(volume).connect(this.context.destination);
      tone.start(begin);
      tone.stop(begin + TONE_S);
    });
  }

  show() {
    this.button.textContent = this.muted ? "Sound off" : this.ready ? "Sound on" : "Sound: tap";
    this.button.setAttribute("aria-pressed", `${!this.muted && this.ready}`);
    this.button.classList.toggle("warn", this.muted || !this.ready);
  }
}
