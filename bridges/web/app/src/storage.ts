// What the browser keeps for this page. It may refuse that, as in a frame of another site: then nothing is kept.

export type Kept = "localStorage" | "sessionStorage";

/** A kept text; null if there is none. */
export function recall(where: Kept, key: string): string | null {
  try {
    return window[where].getItem(key);
  } catch {
    return null;
  }
}

/** Keeps a text if the browser lets it; null removes it. */
export function keep(where: Kept, key: string, text: string | null): void {
  try {
    if (text === null) window[where].removeItem(key);
    else window[where].setItem(key, text);
  } catch {
    // The page works without.
  }
}

/** Removes all kept texts whose keys begin so. */
export function forgetAll(where: Kept, beginning: string): void {
  try {
    for (const key of Object.keys(window[where])) if (key.startsWith(beginning)) window[where].removeItem(key);
  } catch {
    // Nothing is kept.
  }
}
