/** The service's API, typed by its contract (`openapi.yaml`). Requests carry the session's cookie. */
import createClient, { type Middleware } from "openapi-fetch";
import type { components, paths } from "./contract";
import { asProblem, problemOf } from "./problem";

export type Schemas = components["schemas"];

/** The header without which the service takes no change from a cookie: pages of other origins cannot send it. */
export const PAGE_HEADER = { "Specimap-Page": "1" } as const;

/** Where the service answers: the folder of this page. */
export const BASE = new URL(".", document.baseURI).href.replace(/\/$/, "");

const middleware: Middleware = {
  onRequest({ request }) {
    for (const [name, value] of Object.entries(PAGE_HEADER)) request.headers.set(name, value);
    return request;
  },
  async onResponse({ response }) {
    if (response.ok || response.status === 304) return undefined;
    const problem = await problemOf(response);
    if (problem.status === 401) listeners.forEach((listener) => listener());
    throw problem;
  },
  onError({ error }) {
    return asProblem(error);
  },
};

const listeners = new Set<() => void>();

/** Call back when the service no longer knows the session. Returns a function that ends that. */
export function onSignedOut(listener: () => void): () => void {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

/**
 * Operations throw a {@link Problem} for every answer that is no success, so that `data` is always there.
 *
 * @example const { data } = await api.GET("/v1/clouds/{cloud_id}", { params: { path: { cloud_id } } });
 */
export const api = createClient<paths>({ baseUrl: BASE, credentials: "same-origin" });
api.use(middleware);

/** Fetch an address of the service that the contract does not type: pictures, arrays. Throws a {@link Problem}. */
export async function fetched(path: string, options: RequestInit = {}): Promise<Response> {
  let answer: Response;
  try {
    answer = await fetch(BASE + path, {
      credentials: "same-origin",
      ...options,
      headers: { ...PAGE_HEADER, ...(options.headers as Record<string, string> | undefined) },
    });
  } catch (error) {
    if (error instanceof DOMException && error.name === "AbortError") throw error;
    throw asProblem(error);
  }
  if (!answer.ok) {
    const problem = await problemOf(answer);
    if (problem.status === 401) listeners.forEach((listener) => listener());
    throw problem;
  }
  return answer;
}

/** Return what an operation answered. */
export async function body<T>(answer: Promise<{ data?: T }>): Promise<T> {
  const { data } = await answer;
  // A success without a body where one is due does not happen: the contract is tested on the other side.
  if (data === undefined) throw new Error("an answer without a body");
  return data;
}
