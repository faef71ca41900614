// How many points are drawn while the map moves, so that it follows the hand on any machine; all of them when it rests.

const TARGET_MS = 40;
const FEWEST = 60_000;

export class FrameBudget {
  #points = 2_000_000;

  get points(): number {
    return Math.round(this.#points);
  }

  /** What the last frame took, with so many points drawn. */
  took(ms: number, drawn: number): void {
    if (ms > 1.3 * TARGET_MS) this.#points = Math.max(FEWEST, drawn * Math.max(0.4, TARGET_MS / ms));
    else if (ms < 0.6 * TARGET_MS) this.#points = Math.min(4_000_000, this.#points * 1.25);
  }
}
