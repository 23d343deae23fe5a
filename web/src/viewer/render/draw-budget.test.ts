import { expect, it } from "vitest";
import { DrawBudget } from "./draw-budget";

/** A machine that draws `perMs` points a millisecond settles near 33 ms a frame. */
it.each([5_000, 20_000, 100_000])("settles at what a machine of %i points a ms draws in a frame", (perMs) => {
  const budget = new DrawBudget(1_200_000);
  for (let i = 0; i < 60; i++) budget.took(Math.max(16, budget.moving / perMs));
  const frame = budget.moving / perMs;
  expect(frame).toBeLessThan(45);
  if (perMs === 100_000) expect(budget.moving).toBe(1_200_000);
  else expect(frame).toBeGreaterThan(20);
});

it("never draws more points than there are", () => {
  expect(new DrawBudget(500).moving).toBe(500);
});

it("says when fewer points no longer help, and takes it back when frames are quick again", () => {
  const budget = new DrawBudget(1_200_000);
  budget.took(200);
  expect(budget.exhausted).toBe(false);
  for (let i = 0; i < 20; i++) budget.took(200);
  expect(budget.exhausted).toBe(true);
  // Half the sharpness makes frames quicker, which must not make it sharp again at once.
  budget.took(30);
  expect(budget.exhausted).toBe(true);
  for (let i = 0; i < 5; i++) budget.took(10);
  expect(budget.exhausted).toBe(false);
});
