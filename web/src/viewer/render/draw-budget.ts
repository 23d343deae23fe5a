/** How many points are drawn while the view moves, so that it stays fluent on any machine. */

const AIM_MS = 33;
const FEWEST = 20_000;

/** Learns from the time between frames; with rest everything is drawn. */
export class DrawBudget {
  private share = 1;

  constructor(private points: number) {}

  reset(points: number): void {
    this.points = points;
  }

  /** Points to draw in a frame of a motion. */
  get moving(): number {
    return Math.max(Math.min(FEWEST, this.points), Math.round(this.points * this.share));
  }

  /** Take the time that the last frame of a motion took, ms. */
  took(ms: number): void {
    // One slow frame may be the machine's; a frame quicker than the aim lets the share grow slowly.
    if (ms > AIM_MS * 1.25) this.share = Math.max(FEWEST / this.points, this.share * Math.max(0.1, AIM_MS / ms));
    else if (ms < AIM_MS * 0.75) this.share = Math.min(1, this.share * 1.15);
  }
}
