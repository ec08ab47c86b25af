// What all pages share: the market, the account that orders, and how it signs.

import { createContext } from "preact";
import type { ComponentChildren } from "preact";
import { useCallback, useContext, useEffect, useMemo, useRef, useState } from "preact/hooks";
import { getAddress } from "viem";
import type { Address, Hex } from "viem";
import { ApiError, get } from "./api";
import { forgetAll, keep, recall } from "./storage";
import { stream } from "./stream";
import { texts } from "./texts";
import type { Agent, Agents, Market, Model, StreamEvent } from "./types";
import { WalletError, announcedWallets, ask, switchChain, transact, watchWallets } from "./wallet";
import type { Announced } from "./wallet";

export type Account =
  | { kind: "local"; address: Address }
  | { kind: "wallet"; address: Address; wallet: Announced; chainId: number };

interface App {
  market: Market;
  block: number;
  /** Who is present; null until it is known. */
  agents: Agents | null;
  /** Robots that were here, the latest first. */
  away: Agent[];
  /** The robot at an address, if it is present or was lately. */
  robotAt: (address: string) => Agent | undefined;
  account: Account | null;
  connect: (wallet: Announced) => Promise<void>;
  useLocal: () => void;
  disconnect: () => void;
  fixChain: () => Promise<void>;
  /** Sends a transaction from the connected wallet. */
  send: (to: Address, data: Hex) => Promise<Hex>;
  notify: (text: string, kind?: "good" | "bad") => void;
  reloadMarket: () => void;
}

const Context = createContext<App | null>(null);
const REMEMBERED = "aira-wallet";

export function useApp(): App {
  return useContext(Context)!;
}

export function AppProvider(props: { market: Market; reloadMarket: () => void; children: ComponentChildren }) {
  const { market, reloadMarket } = props;
  const [block, setBlock] = useState(market.block);
  const [account, setAccount] = useState<Account | null>(null);
  const [notes, setNotes] = useState<{ id: number; text: string; kind: string }[]>([]);
  const lastNote = useRef(0);

  useEffect(() => setBlock((known) => Math.max(known, market.block)), [market.block]);
  useTopic("chain", (event) => event.kind === "block" && setBlock(event.data.number));
  const listed = useData<Agents>("agents");
  const [live, setLive] = useState<Agents | null>(null);
  useTopic("agents", (event) => (event.kind === "agents" ? setLive(event.data) : listed.reload()));
  const agents = live ?? listed.data;
  const away = useMemo(() => (agents?.away ?? []).map((one): Agent => ({ ...one, role: "agent", health: "away", status: null, offers: [] })).sort((one, other) => other.since! - one.since!), [agents]);

  const notify = useCallback((text: string, kind: "good" | "bad" = "good") => {
    const id = ++lastNote.current;
    setNotes((known) => [...known.slice(-3), { id, text, kind }]);
    setTimeout(() => setNotes((known) => known.filter((note) => note.id !== id)), 9000);
  }, []);

  const adopt = useCallback(async (wallet: Announced, method: string) => {
    const accounts: string[] = await ask(wallet.provider, method);
    if (!accounts.length) return;
    const chainId = Number(await ask(wallet.provider, "eth_chainId"));
    setAccount({ kind: "wallet", address: getAddress(accounts[0]), wallet, chainId });
    keep("localStorage", REMEMBERED, wallet.info.rdns);
  }, []);

  const connect = useCallback((wallet: Announced) => adopt(wallet, "eth_requestAccounts"), [adopt]);
  const useLocal = useCallback(() => {
    if (market.account) setAccount({ kind: "local", address: market.account });
    keep("localStorage", REMEMBERED, "local");
  }, [market.account]);
  const disconnect = useCallback(() => {
    setAccount(null);
    keep("localStorage", REMEMBERED, "nobody");
  }, []);

  // The account of the last visit, if its wallet still gives it without asking.
  useEffect(() => {
    const remembered = recall("localStorage", REMEMBERED);
    if (market.account && (remembered === "local" || remembered === null)) setAccount({ kind: "local", address: market.account });
    const resume = () => {
      const wallet = announcedWallets().find((one) => one.info.rdns === remembered);
      if (wallet) adopt(wallet, "eth_accounts").catch(() => {});
    };
    resume();
    return watchWallets(resume);
  }, []);

  const wallet = account?.kind === "wallet" ? account.wallet : null;
  useEffect(() => {
    if (!wallet) return;
    let current = true;
    wallet.provider.on?.("accountsChanged", (accounts: string[]) => {
      if (!current) return;
      if (accounts.length) setAccount((known) => known?.kind === "wallet" ? { ...known, address: getAddress(accounts[0]) } : known);
      else disconnect();
    });
    wallet.provider.on?.("chainChanged", (chainId: string) => {
      if (current) setAccount((known) => known?.kind === "wallet" ? { ...known, chainId: Number(chainId) } : known);
    });
    return () => {
      current = false;
    };
  }, [wallet]);

  const app = useMemo<App>(() => {
    const connected = () => {
      if (account?.kind !== "wallet") throw new WalletError(texts.needsWallet, false, false);
      return account;
    };
    return {
      market,
      block,
      agents,
      away,
      robotAt: (address) => [...(agents?.agents ?? []), ...away].find((agent) => agent.role === "agent" && agent.address === address),
      account,
      connect,
      useLocal,
      disconnect,
      notify,
      reloadMarket,
      fixChain: async () => {
        const { wallet } = connected();
        await switchChain(wallet.provider, market.chainId);
        const chainId = Number(await ask(wallet.provider, "eth_chainId"));
        setAccount((known) => known?.kind === "wallet" ? { ...known, chainId } : known);
      },
      send: async (to, data) => {
        const { wallet, address, chainId } = connected();
        if (chainId !== market.chainId) throw new WalletError(texts.wrongChain(chainId, market.chainId), false, false);
        return transact(wallet.provider, address, to, data);
      },
    };
  }, [market, block, agents, account]);

  return (
    <Context.Provider value={app}>
      {props.children}
      <div class="notes" role="status" aria-live="polite">
        {notes.map((note) => <p key={note.id} class={`note ${note.kind}`}>{note.text}</p>)}
      </div>
    </Context.Provider>
  );
}

/** The words for an error of any kind. */
export function wordsOf(error: unknown): string {
  if (error instanceof ApiError) return error.hint ? `${error.message} — ${error.hint}` : error.message;
  return error instanceof Error ? error.message : String(error);
}

/** Calls `listener` for the events of a topic, as long as the component is shown. */
export function useTopic(topic: string | null, listener: (event: StreamEvent) => void): void {
  const latest = useRef(listener);
  latest.current = listener;
  useEffect(() => (topic ? stream.on(topic, (event) => latest.current(event)) : undefined), [topic]);
}

/** Calls `act` each time so many milliseconds have passed, as long as the component is shown and `on`. */
export function useEvery(milliseconds: number, act: () => void, on = true): void {
  const latest = useRef(act);
  latest.current = act;
  useEffect(() => {
    if (!on) return;
    const timer = setInterval(() => latest.current(), milliseconds);
    return () => clearInterval(timer);
  }, [milliseconds, on]);
}

/** Whether the server's events come; null until that is known. */
export function useLive(): boolean | null {
  const [live, setLive] = useState(stream.live);
  useEffect(() => stream.watch(setLive), []);
  return live;
}

/** Whether only the connection is to blame, of which the page says everywhere that it is lost. */
export function isUnreachable(error: unknown): boolean {
  return error instanceof ApiError && error.code === "unreachable";
}

/** Calls `again` when the connection is back, if that is what made it fail. */
export function useReturn(error: unknown, again: () => void): void {
  const live = useLive();
  useEffect(() => {
    if (live && isUnreachable(error)) again();
  }, [live]);
}

const typedHere = () => `aira-typed ${location.hash} `;

/** The state of a form, which is still there when the page at this address is loaded again or returned to; and what forgets it. */
export function useTyped<T>(name: string, initial: () => T): [T, (value: T) => void, () => void] {
  const key = useMemo(() => typedHere() + name, []);
  const [value, setValue] = useState<T>(() => JSON.parse(recall("sessionStorage", key) ?? "null") ?? initial());
  useEffect(() => keep("sessionStorage", key, JSON.stringify(value, (_, one) => (one instanceof File ? null : one))), [value]);
  return [value, setValue, () => keep("sessionStorage", key, null)];
}

/** Forgets what was typed at this address: it is ordered. */
export function forgetTyped(): void {
  forgetAll("sessionStorage", typedHere());
}

const models = new Map<string, Promise<Model>>();

/** The model with a CID, read once; null until it is known. */
export function useModel(cid: string): Model | null {
  const live = useLive();
  const [found, setFound] = useState<Model | null>(null);
  useEffect(() => {
    let current = true;
    if (!cid) return;
    if (!models.has(cid)) models.set(cid, get<Model>(`models/${cid}`));
    models.get(cid)!.then((model) => current && setFound(model), () => models.delete(cid));
    return () => {
      current = false;
    };
  }, [cid, live]);
  return found?.cid === cid ? found : null;
}

export interface Loaded<T> {
  data: T | null;
  error: unknown;
  loading: boolean;
  reload: () => void;
}

/** What the server answers at `path`; read again by `reload`, and at each event of `topic`, which keeps what is shown meanwhile. */
export function useData<T>(path: string | null, topic: string | null = null): Loaded<T> {
  const [state, setState] = useState<{ path: string | null; data: T | null; error: unknown; loading: boolean }>({
    path, data: null, error: null, loading: path !== null,
  });
  const [turn, setTurn] = useState(0);
  const waiting = useRef<ReturnType<typeof setTimeout> | null>(null);
  useEffect(() => {
    if (path === null) return setState({ path, data: null, error: null, loading: false });
    const stopped = new AbortController();
    setState((known) => ({ path, data: known.path === path ? known.data : null, error: null, loading: true }));
    get<T>(path, stopped.signal).then(
      (data) => setState({ path, data, error: null, loading: false }),
      (error) => {
        if (!stopped.signal.aborted) setState((known) => ({ ...known, error, loading: false }));
      },
    );
    return () => stopped.abort();
  }, [path, turn]);
  const reload = useCallback(() => {
    waiting.current ??= setTimeout(() => {
      waiting.current = null;
      setTurn((known) => known + 1);
    }, 60);
  }, []);
  useTopic(topic, reload);
  useReturn(state.error, reload);
  const current = state.path === path;
  return { data: current ? state.data : null, error: current ? state.error : null, loading: !current || state.loading, reload };
}
