/** The signed-in session: a signal that all pages read. */
import { signal } from "@preact/signals";
import { api, body, onSignedOut, type Schemas } from "../api/client";
import { asProblem, type Problem } from "../api/problem";

export type Session = Schemas["Session"];

/** `undefined`: not known yet. `null`: nobody is signed in. */
export const session = signal<Session | null | undefined>(undefined);
/** Why the session could not be looked up. */
export const sessionProblem = signal<Problem | null>(null);
/** Whether a session ended while the page was in use: the sign-in page says so. */
export const sessionLost = signal(false);

const BEFORE = "specimap.signed-in";
/** Whether somebody was signed in here before a reload; of this tab, and no more than that. */
const before = {
  get: () => tried(() => sessionStorage.getItem(BEFORE) !== null) ?? false,
  set: (value: boolean) =>
    tried(() => (value ? sessionStorage.setItem(BEFORE, "1") : sessionStorage.removeItem(BEFORE))),
};

onSignedOut(() => {
  if (session.value || before.get()) sessionLost.value = true;
  session.value = null;
});

// A page that was opened without a network goes on by itself when it is there.
addEventListener("online", () => {
  if (sessionProblem.value) void findSession();
});

/** Find out whether somebody is signed in. */
export async function findSession(): Promise<void> {
  try {
    session.value = await body(api.GET("/v1/session"));
    before.set(true);
    sessionProblem.value = null;
  } catch (thrown) {
    const problem = asProblem(thrown);
    if (problem.status === 401) session.value = null;
    else sessionProblem.value = problem;
  }
}

/** Sign in with a key, or with the token of a shared link. Throws a {@link Problem}. The key is not kept. */
export async function signIn(with_: { key: string } | { share: string }): Promise<Session> {
  const made = await body(api.POST("/v1/session", { body: with_ }));
  sessionLost.value = false;
  before.set(true);
  session.value = made;
  return made;
}

/** Sign out here; the cookie is worth nothing afterwards. */
export async function signOut(): Promise<void> {
  await api.DELETE("/v1/session").catch(() => undefined);
  sessionLost.value = false;
  before.set(false);
  session.value = null;
}

function tried<T>(act: () => T): T | undefined {
  try {
    return act();
  } catch {
    // A browser that keeps nothing.
    return undefined;
  }
}

/** Whether the session's key has a scope; an administrator's has all. */
export function may(scope: string): boolean {
  const scopes = session.value?.scopes ?? [];
  return scopes.includes("admin") || scopes.includes(scope);
}
