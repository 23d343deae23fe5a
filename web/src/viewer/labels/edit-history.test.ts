import { expect, it } from "vitest";
import { EditHistory } from "./edit-history";

it("takes strokes back and does them again, to the very values", () => {
  const values = Uint8Array.of(0, 0, 3, 3, 0);
  const history = new EditHistory(values);
  expect(history.paint([0, 2], 1)).toBe(2);
  expect(history.paint([2, 3], 1)).toBe(1);
  expect(history.end()).toBe(true);
  history.paint([3, 4], 2);
  history.end();
  expect([...values]).toEqual([1, 0, 1, 2, 2]);
  history.undo();
  expect([...values]).toEqual([1, 0, 1, 1, 0]);
  history.undo();
  expect([...values]).toEqual([0, 0, 3, 3, 0]);
  expect(history.canUndo).toBe(false);
  history.redo();
  history.redo();
  expect([...values]).toEqual([1, 0, 1, 2, 2]);
  expect(history.canRedo).toBe(false);
});

it("forgets what was undone when something new is painted, and knows empty strokes", () => {
  const history = new EditHistory(Uint8Array.of(0, 1));
  history.paint([0], 1);
  history.end();
  history.undo();
  history.paint([1], 1);
  expect(history.end()).toBe(false);
  expect(history.canRedo).toBe(true);
  history.paint([1], 2);
  history.end();
  expect(history.canRedo).toBe(false);
  expect(history.paint([99], 1)).toBe(0);
});
