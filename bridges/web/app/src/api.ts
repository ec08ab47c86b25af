// Requests to the server. What changes something is a POST with a header that no other site can send.

import { parseExact } from "./numbers";
import { texts } from "./texts";

/** An answer with an error: `code` is one of docs/reference/codes.md, `hint` says what to do. */
export class ApiError extends Error {
  constructor(
    readonly code: string,
    message: string,
    readonly hint = "",
  ) {
    super(message);
  }
}

export async function get<T>(path: string, signal?: AbortSignal): Promise<T> {
  return (await request(path, { signal })).json();
}

/** The same, with integers that a number can't hold as bigint. */
export async function getExact<T>(path: string, signal?: AbortSignal): Promise<T> {
  return parseExact(await (await request(path, { signal })).text());
}

export async function post<T>(path: string, body: unknown): Promise<T> {
  return postText(path, JSON.stringify(body));
}

export async function postText<T>(path: string, body: string): Promise<T> {
  const headers = { "Content-Type": "application/json", "X-Aira-Request": "1" };
  return (await request(path, { method: "POST", headers, body })).json();
}

export async function postFile<T>(path: string, body: Blob): Promise<T> {
  const headers = { "Content-Type": "application/octet-stream", "X-Aira-Request": "1" };
  return (await request(path, { method: "POST", headers, body })).json();
}

/** The bytes of a file; at most `most` of them. */
export async function getBytes(cid: string, most: number): Promise<Uint8Array<ArrayBuffer>> {
  const response = await request(`files/${cid}`, {});
  if (Number(response.headers.get("Content-Length") ?? 0) > most) throw new ApiError("too-large", texts.fileTooLarge);
  return new Uint8Array(await response.arrayBuffer());
}

async function request(path: string, init: RequestInit): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(`/api/v1/${path}`, init);
  } catch (error) {
    if ((error as Error).name === "AbortError") throw error;
    throw new ApiError("unreachable", texts.unreachable, texts.unreachableHint);
  }
  if (response.ok) return response;
  const answer = await response.json().catch(() => null);
  const { code = `http-${response.status}`, message = response.statusText, hint = "" } = answer?.error ?? {};
  throw new ApiError(code, message, hint);
}

export function query(fields: Record<string, string | number | undefined>): string {
  const given = Object.entries(fields).filter(([, value]) => value !== undefined && value !== "");
  return given.length ? `?${new URLSearchParams(given.map(([name, value]) => [name, String(value)]))}` : "";
}
