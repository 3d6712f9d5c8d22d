// The keys that fly, by the time that each was held since it was last asked for: a key let go between two frames counts too.

const FLIES = /^(Key[WASDQE]|Arrow)/;
const LONGEST = 0.5; // seconds of flying that one frame carries out

export class HeldKeys {
  constructor() { Object.assign(this, { since: new Map(), held: new Map() }); } // by key: milliseconds

  // Returns whether it is one of these keys.
  press({ code }) {
    if (!FLIES.test(code)) return false;
    if (!this.since.has(code)) this.since.set(code, performance.now()); // a key that repeats was pressed once
    return true;
  }

  release({ code }) {
    if (this.since.has(code)) this.held.set(code, this.heldFor(code, performance.now()));
    this.since.delete(code);
  }

  clear() { this.since.clear(), this.held.clear(); }

  heldFor(code, now) { return (this.held.get(code) ?? 0) + (this.since.has(code) ? now - this.since.get(code) : 0); }

  // Returns the seconds of flying to the right, up and ahead since the last call; null: no key was held.
  take() {
    const now = performance.now(), { since, held } = this;
    if (!since.size && !held.size) return null;
    const of = (...codes) => Math.min(LONGEST, Math.max(...codes.map((code) => this.heldFor(code, now))) / 1000);
    const flown = [of("KeyD", "ArrowRight") - of("KeyA", "ArrowLeft"), of("KeyE") - of("KeyQ"), of("KeyW", "ArrowUp") - of("KeyS", "ArrowDown")];
    held.clear();
    for (const code of since.keys()) since.set(code, now);
    return flown;
  }
}
