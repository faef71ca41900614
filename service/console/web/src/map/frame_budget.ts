// Number of points that are drawn while the map moves, so that it stays responsive on any machine; more at rest.

const TARGET_MS = 40;
/** A map at rest may take longer, but not so long that the next click waits for it. */
const REST_TARGETS = 10;
const FEWEST = 30_000;

export class FrameBudget {
  #points = 200_000;

  get points(): number {
    return Math.round(this.#points);
  }

  get pointsAtRest(): number {
    return REST_TARGETS * this.points;
  }

  /** Report the time of the last frame and its number of points. */
  took(ms: number, drawn: number): void {
    if (ms > 1.3 * TARGET_MS) this.#points = Math.max(FEWEST, drawn * Math.max(0.4, TARGET_MS / ms));
    else if (ms < 0.6 * TARGET_MS) this.#points = Math.min(4_000_000, this.#points * 1.25);
  }
}
