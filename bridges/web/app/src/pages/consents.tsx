import { post } from "../api";
import { useApp, useData, useEvery } from "../app";
import { texts } from "../texts";
import type { Consent } from "../types";
import { Action, Facts, Name, Show, Strange } from "../ui";
import { OperatorLogin } from "./services";

/** The orders of programs that wait for the owner's yes. */
export function Consents() {
  const { market } = useApp();
  const isOperator = market.role === "operator";
  const listed = useData<{ consents: Consent[] }>(isOperator ? "consents" : null);
  useEvery(3_000, listed.reload, isOperator);
  return (
    <section class="panel">
      <h2>{texts.consents}</h2>
      <p class="hint">{texts.consentsHint}</p>
      {isOperator ? (
        <Show of={listed}>
          {({ consents }) => consents.length ? (
            <ul class="plain">{consents.map((one) => <Waiting key={one.id} consent={one} answered={listed.reload} />)}</ul>
          ) : <p class="quiet">{texts.noConsents}</p>}
        </Show>
      ) : <OperatorLogin what={texts.consentLogin} hint={texts.operatorTokenHint} />}
    </section>
  );
}

function Waiting({ consent, answered }: { consent: Consent; answered: () => void }) {
  const { notify } = useApp();
  const answer = (allow: boolean) => async () => {
    await post(`consents/${consent.id}`, { allow });
    notify(allow ? texts.consentGiven : texts.consentDenied);
    answered();
  };
  const { messages, more } = consent;
  return (
    <li class="consent">
      <Facts
        of={[
          [texts.consentCost, consent.cost.text],
          [texts.robot, /^0x/.test(consent.robot) ? <Name text={consent.robot} href={`#/robot/${consent.robot}`} /> : consent.robot],
          [texts.model, <Name text={consent.model} />],
          [texts.consentWhy, consent.why],
          [texts.consentNote, consent.note.text ? <Strange text={consent.note.text} /> : ""],
          [texts.consentUntil, new Date(consent.expires).toLocaleString()],
        ]}
      />
      <pre>{messages.map(({ text }) => <><Strange text={text} most={300} />{"\n"}</>)}{more ? texts.moreMessages(more) : ""}</pre>
      <p class="row">
        <Action id={`allow-${consent.id}`} class="button" run={answer(true)}>{texts.consentAllow}</Action>
        <Action id={`deny-${consent.id}`} class="button quietly" run={answer(false)}>{texts.consentDeny}</Action>
      </p>
    </li>
  );
}
