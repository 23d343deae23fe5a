/** The signed-in session: a signal that all pages read. */
import { signal } from "@preact/signals";
import { api, BASE, body, onSignedOut, type Schemas } from "../api/client";
import { asProblem, type Problem } from "../api/problem";

export type Session = Schemas["Session"];
export type Permission =
  | "audit.read"
  | "capture.write"
  | "job.run"
  | "job.urgent"
  | "key.manage"
  | "label.write"
  | "project.manage"
  | "result.read"
  | "service.watch"
  | "share.manage"
  | "study.manage";

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

/** Sign out here, and at the identity provider where the account is one of its; the cookie is worth nothing afterwards. */
export async function signOut(): Promise<void> {
  const elsewhere = isPerson()
    ? await body(api.POST("/v1/sso/logout")).then((answer) => answer.end_session_url, () => null)
    : null;
  if (elsewhere === null) await api.DELETE("/v1/session").catch(() => undefined);
  sessionLost.value = false;
  before.set(false);
  session.value = null;
  if (elsewhere !== null) location.assign(elsewhere);
}

/** Sign in with the account of the identity provider: the browser leaves, and comes back to the page that is shown. */
export function signInElsewhere(): void {
  before.set(true);
  location.assign(`${BASE}/v1/sso/login?${new URLSearchParams({ return_to: location.hash.slice(1) }).toString()}`);
}

/** Whether somebody is signed in with the account of the identity provider. */
export function isPerson(): boolean {
  return session.value?.key_id.startsWith("person_") ?? false;
}

function tried<T>(act: () => T): T | undefined {
  try {
    return act();
  } catch {
    // A browser that keeps nothing.
    return undefined;
  }
}

/** Whether the session has a permission of docs/identity.md. */
export function may(permission: Permission): boolean {
  return session.value?.permissions.includes(permission) ?? false;
}
