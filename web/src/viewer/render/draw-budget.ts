/** How many points are drawn while the view moves, so that it stays fluent on any machine. */

const AIM_MS = 33;
const FEWEST = 20_000;

/** Learns from the time between frames; with rest everything is drawn. */
export class DrawBudget {
  private share = 1;
  private late = false;

  constructor(private points: number) {}

  reset(points: number): void {
    this.points = points;
  }

  /** Points to draw in a frame of a motion. */
  get moving(): number {
    return Math.max(Math.min(FEWEST, this.points), Math.round(this.points * this.share));
  }

  /** Whether the fewest points are still too slow: what is left to save is pixels. */
  get exhausted(): boolean {
    return this.moving <= FEWEST && this.late;
  }

  /** Take the time that the last frame of a motion took, ms. */
  took(ms: number): void {
    this.late = ms > AIM_MS * (this.late ? 0.5 : 1.25);
    // One slow frame may be the machine's; a frame quicker than the aim lets the share grow slowly.
    if (ms > AIM_MS * 1.25) this.share = Math.max(FEWEST / this.points, this.share * Math.max(0.1, AIM_MS / ms));
    else if (ms < AIM_MS * 0.75) this.share = Math.min(1, this.share * 1.15);
  }
}
