import { render } from "preact";
import { useEffect, useState } from "preact/hooks";
import { isAddress } from "viem";
import { ApiError } from "./api";
import { AppProvider, useApp, useData, useEvery, useLive, useTopic, wordsOf } from "./app";
import { isCid } from "./cid";
import { plain } from "./format";
import { postAgain } from "./ordering";
import { AccountControl, AccountPage } from "./pages/account";
import { FollowPage } from "./pages/follow";
import { JobPage } from "./pages/job";
import { JobsPage } from "./pages/jobs";
import { LoginForm } from "./pages/login";
import { MarketPage } from "./pages/market";
import { OrderPage } from "./pages/order";
import { FilePage } from "./pages/recording";
import { RobotPage } from "./pages/robot";
import { RobotsPage } from "./pages/robots";
import { SinglePage } from "./pages/single";
import { SitePage } from "./pages/site";
import "./style.css";
import { texts } from "./texts";
import type { Market } from "./types";

const TABS = ["robots", "jobs", "market", "site"] as const;
/** The tab of each other page. */
const TAB_OF: Record<string, (typeof TABS)[number]> = { order: "robots", robot: "robots", account: "jobs", file: "jobs", job: "jobs" };

function useRoute(): string[] {
  const read = () => location.hash.replace(/^#\/?/, "").split("/").filter(Boolean);
  const [route, setRoute] = useState(read);
  useEffect(() => {
    const changed = () => {
      setRoute(read());
      scrollTo(0, 0);
    };
    addEventListener("hashchange", changed);
    return () => removeEventListener("hashchange", changed);
  }, []);
  return route;
}

function Page() {
  const market = useData<Market>("market");
  const { data, error } = market;
  if (data) return <AppProvider market={data} reloadMarket={market.reload}><Shell /></AppProvider>;
  if (error instanceof ApiError && error.code === "login-required") {
    return <main class="login"><h1>AIRA</h1><LoginForm label={texts.token} hint={texts.tokenHint} done={market.reload} /></main>;
  }
  return <main>{error ? <Broken error={error} retry={market.reload} /> : <p class="quiet" aria-busy="true">{texts.loading}</p>}</main>;
}

/** Tries again by itself, because a server that starts needs a moment. */
function Broken(props: { error: unknown; retry: () => void }) {
  useEvery(3_000, props.retry);
  return <div class="problem" role="alert"><p>{wordsOf(props.error)}</p><button type="button" class="button small" onClick={props.retry}>{texts.again}</button></div>;
}

function Shell() {
  const { market } = useApp();
  const route = useRoute();
  const inFrame = window.top !== window.self;
  const onOwnPage = market.robot && (!route.length || inFrame && !["order", "job", "file"].includes(route[0]));
  if (onOwnPage) return <><main><SinglePage robot={market.robot!} /></main><footer><Connection /></footer></>;
  return (
    <>
      <a class="skip" href="#main" onClick={skip}>{texts.skip}</a>
      {inFrame ? null : <Header route={route} />}
      <main id="main" tabIndex={-1} class={`on-${route[0] ?? "robots"}`}><Content route={route} /></main>
      <footer>
        <span>{plain(market.lighthouse.name, 60)}</span>
        <Connection />
        <span class="quiet">AIRA {plain(market.version, 30)}</span>
      </footer>
    </>
  );
}

/** To the content without a change of the route, which is in the same part of the address. */
function skip(event: Event): void {
  event.preventDefault();
  document.getElementById("main")!.focus();
}

function Header(props: { route: string[] }) {
  const current = props.route[0] ?? "robots";
  const tabs = TAB_OF[current] ?? current;
  return (
    <header class="top">
      <a class="brand" href="#/"><img src="/icon.svg" alt="" width={26} height={26} /> AIRA</a>
      <nav aria-label={texts.pages}>
        {TABS.map((tab) => <a key={tab} href={`#/${tab}`} aria-current={tab === tabs ? "page" : undefined}><Icon of={tab} />{texts.tab[tab]}</a>)}
      </nav>
      <AccountControl />
    </header>
  );
}

const ICONS = {
  robots: "M5 8h14v9H5zM12 8V4M9 12h.01M15 12h.01M9 20v-3M15 20v-3M2 12v2M22 12v2",
  jobs: "M8 6h12M8 12h12M8 18h12M4 6h.01M4 12h.01M4 18h.01",
  market: "M4 19V5M4 19h16M8 15l4-5 3 3 5-7",
  site: "M12 3v18M12 3l-4 6h8zM8 21h8M5 13l3-4M19 13l-3-4",
};

function Icon(props: { of: (typeof TABS)[number] }) {
  return <svg class="icon" viewBox="0 0 24 24" aria-hidden="true" fill="none" stroke="currentColor" stroke-width="1.8" stroke-linecap="round" stroke-linejoin="round"><path d={ICONS[props.of]} /></svg>;
}

function Content({ route }: { route: string[] }) {
  const [page = "robots", first = "", second = "", third = "", fourth = ""] = route;
  useEffect(() => {
    document.title = `${texts.tab[TAB_OF[page] ?? (page as (typeof TABS)[number])] ?? texts.tab.robots} · AIRA`;
  }, [page]);
  switch (page) {
    case "order":
      if (first && first !== "model") return <FollowPage key={first} hash={first} />;
      return second ? <OrderPage key={route.join()} model={second} robot={isAddress(third) ? third : ""} objective={[third, fourth].find(isCid) ?? ""} /> : <RobotsPage />;
    case "market":
      return <MarketPage />;
    case "jobs":
      return <JobsPage />;
    case "job":
      return <JobPage key={first} address={first} />;
    case "file":
      return <FilePage key={first} cid={first} />;
    case "account":
      return <AccountPage key={first} address={first} />;
    case "robots":
      return <RobotsPage />;
    case "robot":
      return <RobotPage key={first} address={first} />;
    case "site":
      return <SitePage part={first} />;
    default:
      return <p class="quiet">{texts.noSuchPage}</p>;
  }
}

/** Whether the page is up to date, and what of the system is not reachable. */
function Connection() {
  const { market, block, reloadMarket } = useApp();
  const live = useLive();
  useTopic("connection", reloadMarket);
  useEffect(() => {
    if (!live) return;
    reloadMarket();
    postAgain(block);
  }, [live]);
  const broken = live === false ? texts.reconnecting : !market.connected.router ? texts.noRouter : !market.connected.chain ? texts.noChain : "";
  return (
    <span id="connection" role="status" class={broken ? "broken" : ""}>
      <span class={`dot ${broken ? "bad" : "good"}`} aria-hidden="true" /> {broken || (live ? texts.live : texts.loading)}<span class="quiet"> · {texts.block(block)}</span>
    </span>
  );
}

render(<Page />, document.getElementById("page")!);
