import { useApp } from "../app";
import { texts } from "../texts";
import { Consents } from "./consents";
import { Lighthouse } from "./provider";
import { Services } from "./services";

const PARTS = ["services", "lighthouse"] as const;

/** For those who run the market: who is present and well, providers, turns, stakes, the order book. */
export function SitePage(props: { part: string }) {
  const { market } = useApp();
  const part = PARTS.find((one) => one === props.part) ?? "services";
  return (
    <>
      <h1>{texts.siteTitle}</h1>
      <div class="tabs">
        {PARTS.map((one) => <a key={one} class="tab" href={`#/site/${one}`} aria-current={one === part ? "page" : undefined}>{texts.sitePart[one]}</a>)}
      </div>
      {market.asksForConsent ? <Consents /> : null}
      {part === "services" ? <Services /> : <Lighthouse />}
    </>
  );
}
