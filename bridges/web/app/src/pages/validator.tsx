// The validator of an order: whom to name, and what its jurors have signed about how they judge.

import { useEffect, useLayoutEffect, useMemo, useState } from "preact/hooks";
import { isAddress, zeroAddress } from "viem";
import type { Address } from "viem";
import { get, query } from "../api";
import { useApp, useData, useTyped } from "../app";
import { amount, short } from "../format";
import { parseAmount } from "../numbers";
import { texts } from "../texts";
import { checkValidator } from "../trust";
import type { Agents, Market, Validator } from "../types";
import { Facts, Name, NumberField, Problem, Show, Strange, WordField } from "../ui";

/** The validator that an order names, and its fee in the smallest unit of XRT. */
export interface Judge {
  address: Address;
  fee: bigint;
  /** Asks again. Throws if what it said has changed. */
  confirm?: () => Promise<void>;
}

export const NOBODY: Judge = { address: zeroAddress, fee: 0n };

/** Milliseconds without a key after which the server is asked. */
const SETTLED = 400;

/** Lets a person name a validator. `choose` gets null while an order must not be signed. */
export function ValidatorChoice(props: { choose: (judge: Judge | null) => void }) {
  const { market, account } = useApp();
  const { choose } = props;
  const [named, setNamed] = useTyped("validator", () => "");
  const [fee, setFee] = useTyped("validator-fee", () => "");
  const [wasNamed] = useState(Boolean(named || fee));
  const [asked, setAsked] = useState<string | null>(null);
  const [problem, setProblem] = useState<unknown>(null);
  const [independent, setIndependent] = useState<boolean | null>(null);
  const offered = fee.trim() === "" ? undefined : parseAmount(fee, market.xrt.decimals);
  const isName = isAddress(named) || /^[^\s/]+\.[^\s/]+$/.test(named);
  const path = isName && offered !== null ? `validators/${encodeURIComponent(named)}${query({ fee: offered?.toString() })}` : null;
  const found = useData<Validator>(asked);
  const said = asked === path ? found.data : null;

  useEffect(() => {
    const timer = setTimeout(() => setAsked(path), SETTLED);
    return () => clearTimeout(timer);
  }, [path]);

  useLayoutEffect(() => {
    let current = true;
    setProblem(null);
    setIndependent(null);
    choose(named || fee ? null : NOBODY);
    if (!said) return;
    checkValidator(said, account, market).then(
      (independent) => {
        if (!current) return;
        setIndependent(independent);
        if (!Object.keys(said.doubts).length) choose({ address: said.validator, fee: BigInt(said.fee), confirm: () => confirmed(path!, said) });
      },
      (error) => current && setProblem(error),
    );
    return () => {
      current = false;
    };
  }, [named, fee, said, account]);

  /** The validator is asked again when the order is looked at. */
  const confirmed = async (asked: string, said: Validator) => {
    const now = await get<Validator>(asked);
    if (now.validator === said.validator && now.fee === said.fee && !Object.keys(now.doubts).length) return;
    found.reload();
    throw new Error(texts.changedLookAgain);
  };

  return (
    <details class="more" id="with-validator" open={wasNamed}>
      <summary>{texts.withValidator}</summary>
      <PresentValidators choose={setNamed} />
      <div class="fields">
        <WordField label={texts.validator} text={named} change={setNamed} error={named && !isName ? texts.notAnAddress : ""} hint={texts.validatorHint} />
        <NumberField label={texts.validatorFee} text={fee} change={setFee} error={offered === null ? texts.notAnAmount : fee && !named ? texts.feeWithoutValidator : ""} hint={texts.validatorFeeHint} />
      </div>
      <div aria-live="polite">
        {problem ? <Problem error={problem} /> : said ? <Announced said={said} independent={independent} /> : asked && asked === path ? <Show of={found}>{() => null}</Show> : null}
      </div>
    </details>
  );
}

/** The validators that are on the market now, to be chosen by a click. */
function PresentValidators(props: { choose: (address: string) => void }) {
  const { market } = useApp();
  const agents = useData<Agents>("agents");
  const present = useMemo(() => validatorsOf(agents.data, market), [agents.data]);
  if (!present.length) return null;
  return (
    <p class="row">
      {texts.validatorsHere}
      {present.map((address) => <button key={address} type="button" class="button small quietly" title={address} onClick={() => props.choose(address)}>{short(address)}</button>)}
    </p>
  );
}

/** Whom orders of this market can name: contracts in generation 5, the jurors' own accounts in generation 3. */
function validatorsOf(agents: Agents | null, market: Market): Address[] {
  const judged = (agents?.agents ?? []).map((agent) => (agent.role === "validator" ? agent.status?.validation?.validators ?? [] : []));
  const named = judged.map((validators) => (market.generation === 3 ? validators.at(-1) : validators.length > 1 ? validators[0] : undefined));
  return [...new Set(named.filter((address) => address !== undefined))].slice(0, 8);
}

/** Who judges, by which policies, for what fee, and what happens if nobody does. */
function Announced(props: { said: Validator; independent: boolean | null }) {
  const { market } = useApp();
  const { said } = props;
  const doubts = Object.entries(said.doubts);
  return (
    <section class="panel" id="announced">
      <h3><Strange text={said.title} most={120} /> <Name text={said.validator} /></h3>
      {doubts.map(([code, words]) => (
        <p class="callout warn" role="alert" key={code}><strong>{texts.refusedValidator}</strong> {words}.</p>
      ))}
      <Facts
        of={[
          [texts.whoJudges, said.online.length ? (
            <>
              {texts.jurorsPresent(said.online.length, said.jurors, said.quorum)}{" "}
              {said.online.map((juror) => <Name key={juror} text={juror} />)}
            </>
          ) : ""],
          [texts.judgesBy, said.policies.length ? (
            <ul class="plain">
              {said.policies.map((policy) => <li key={policy.name + policy.description}><code><Strange text={policy.name} most={60} /></code> <Strange text={policy.description} /></li>)}
              {said.unanimous ? null : <li>{texts.notUnanimous}</li>}
            </ul>
          ) : ""],
          [texts.itsFee, `${amount(said.fee, market.xrt)}, ${texts.feeOnTop}`],
          [texts.ifSilent, `${said.refund}.`],
          [texts.signedBy, props.independent === null || !said.online.length ? "" : texts.announcementChecked(props.independent ? texts.walletsNode : texts.serversNode)],
        ]}
      />
    </section>
  );
}
