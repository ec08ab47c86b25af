import { render } from "preact";
import { useEffect, useState } from "preact/hooks";
import { ApiError } from "./api";
import { AppProvider, useApp, useData, useLive, wordsOf } from "./app";
import { plain } from "./format";
import { postAgain } from "./ordering";
import { AccountControl, AccountPage } from "./pages/account";
import { FollowPage } from "./pages/follow";
import { JobPage } from "./pages/job";
import { JobsPage } from "./pages/jobs";
import { LoginForm } from "./pages/login";
import { MarketPage } from "./pages/market";
import { OrderPage } from "./pages/order";
import { ProviderPage } from "./pages/provider";
import { FilePage } from "./pages/recording";
import { RobotPage } from "./pages/robot";
import { RobotsPage } from "./pages/robots";
import "./style.css";
import { texts } from "./texts";
import type { Market } from "./types";

const TABS = ["order", "market", "jobs", "robots", "provider"] as const;

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
  useEffect(() => {
    const timer = setInterval(props.retry, 3000);
    return () => clearInterval(timer);
  }, []);
  return <div class="problem" role="alert"><p>{wordsOf(props.error)}</p><button type="button" class="button small" onClick={props.retry}>{texts.again}</button></div>;
}

function Shell() {
  const { market } = useApp();
  const route = useRoute();
  const inFrame = window.top !== window.self;
  const onOwnPage = market.robot && (!route.length || inFrame && !["order", "job", "file"].includes(route[0]));
  if (onOwnPage) return <main><RobotPage robot={market.robot!} /></main>;
  return (
    <>
      <a class="skip" href="#main" onClick={skip}>{texts.skip}</a>
      {inFrame ? null : <Header route={route} />}
      <main id="main" tabIndex={-1} class={`on-${route[0] ?? "order"}`}><Content route={route} /></main>
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
  const current = props.route[0] ?? "order";
  const tabs = current === "account" || current === "file" || current === "job" ? "jobs" : current;
  return (
    <header class="top">
      <a class="brand" href="#/order"><img src="/icon.svg" alt="" width={26} height={26} /> AIRA</a>
      <nav aria-label={texts.pages}>
        {TABS.map((tab) => <a key={tab} href={`#/${tab}`} aria-current={tab === tabs ? "page" : undefined}>{texts.tab[tab]}</a>)}
      </nav>
      <AccountControl />
    </header>
  );
}

function Content({ route }: { route: string[] }) {
  const [page = "order", first = "", second = ""] = route;
  useEffect(() => {
    document.title = `${texts.tab[page as keyof typeof texts.tab] ?? texts.tab.jobs} · AIRA`;
  }, [page]);
  switch (page) {
    case "order":
      return first && first !== "model" ? <FollowPage key={first} hash={first} /> : <OrderPage key={second} model={second} />;
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
    case "provider":
      return <ProviderPage />;
    default:
      return <p class="quiet">{texts.noSuchPage}</p>;
  }
}

/** Whether the page is up to date, and what of the system is not reachable. */
function Connection() {
  const { market, block, reloadMarket } = useApp();
  const live = useLive();
  useEffect(() => {
    const timer = setInterval(reloadMarket, 10_000);
    return () => clearInterval(timer);
  }, []);
  useEffect(() => {
    if (!live) return;
    reloadMarket();
    postAgain(block);
  }, [live]);
  const broken = !live ? texts.reconnecting : !market.connected.router ? texts.noRouter : !market.connected.chain ? texts.noChain : "";
  return (
    <span id="connection" role="status" class={broken ? "broken" : ""}>
      <span class={`dot ${broken ? "bad" : "good"}`} aria-hidden="true" /> {broken || texts.live} · {texts.block(block)}
    </span>
  );
}

render(<Page />, document.getElementById("page")!);
