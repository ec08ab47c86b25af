import { useState, useEffect } from "preact/hooks";
import { useApp, useData, useModel } from "../app";
import { clock, ether, plain, short } from "../format";
import { withdraw } from "../ordering";
import { texts } from "../texts";
import type { AccountState, Liability, PostedOrder } from "../types";
import { Action, Badge, Dialog, Facts, Money, Name, Picture, Show, Strange, Table } from "../ui";
import { announcedWallets, watchWallets } from "../wallet";
import { nameOf } from "./robots";

/** The account in the page's head: which one orders, and how to change it. */
export function AccountControl() {
  const { account, market, connect, useLocal, disconnect, fixChain } = useApp();
  const [open, setOpen] = useState(false);
  const [wallets, setWallets] = useState(announcedWallets());
  useEffect(() => watchWallets(() => setWallets(announcedWallets())), []);
  const wrongChain = account?.kind === "wallet" && account.chainId !== market.chainId;
  return (
    <div class="account">
      {wrongChain ? <Action class="button small warn" run={fixChain}>{texts.switchChain}</Action> : null}
      {account ? (
        <button type="button" id="account" class="button small quietly" onClick={() => setOpen(true)}>
          <span class={`dot ${wrongChain ? "bad" : "good"}`} aria-hidden="true" />
          {account.kind === "local" ? texts.localAccount : plain(account.wallet.info.name, 30)}
        </button>
      ) : (
        <button type="button" id="connect" class="button small" onClick={() => setOpen(true)}>{texts.connect}</button>
      )}
      <Dialog title={texts.whoOrders} open={open} onClose={() => setOpen(false)}>
        <ul class="choices">
          {market.account ? (
            <li>
              <Action class="choice" run={() => { useLocal(); setOpen(false); }} id="use-local">
                <strong>{texts.localAccount}</strong>
                <span class="quiet">{texts.localAccountHint}</span>
              </Action>
            </li>
          ) : null}
          {wallets.map((wallet) => (
            <li key={wallet.info.uuid}>
              <Action class="choice" run={async () => { await connect(wallet); setOpen(false); }}>
                <strong>{plain(wallet.info.name, 60)}</strong>
                <span class="quiet">{plain(wallet.info.rdns, 60)}</span>
              </Action>
            </li>
          ))}
        </ul>
        {!wallets.length && !market.account ? <p class="quiet">{texts.noWallet}</p> : null}
        {account ? (
          <p class="row">
            <a class="button small quietly" href={`#/account/${account.address}`} onClick={() => setOpen(false)}>{texts.myAccount}</a>
            <Action class="button small quietly" run={() => { disconnect(); setOpen(false); }}>{texts.disconnect}</Action>
          </p>
        ) : null}
      </Dialog>
    </div>
  );
}

export function AccountPage(props: { address: string }) {
  const { market, account } = useApp();
  const loaded = useData<AccountState>(`accounts/${props.address}`, "chain");
  return (
    <>
      <h1>{account?.address === props.address ? texts.myAccount : texts.account} <Name text={props.address} label={short(props.address)} /></h1>
      <Show of={loaded}>
        {(state) => (
          <>
            <Facts
              of={[
                [texts.balance, <Money units={state.token.balance} token={market.token} />],
                [market.token.address === market.xrt.address ? "" : "XRT", <Money units={state.xrt.balance} token={market.xrt} />],
                [texts.gas, ether(state.eth)],
                [texts.allowed, <Money units={state.token.allowance} token={market.token} />],
                [texts.spent, <Money units={state.spent} token={market.token} />],
                [texts.earned, <Money units={state.record.earned} token={market.token} />],
                [texts.asRobot, texts.recordOf(state.record)],
              ].filter(([name]) => name) as [string, any][]}
            />
            <h2>{texts.openOrders}</h2>
            <OrderTable orders={state.orders} changed={loaded.reload} />
            <h2>{texts.jobs}</h2>
            <JobTable liabilities={state.liabilities} />
          </>
        )}
      </Show>
    </>
  );
}

export function OrderTable(props: { orders: PostedOrder[]; changed: () => void }) {
  const { market, account } = useApp();
  return (
    <Table label={texts.openOrders} head={[texts.order, texts.state, texts.price, texts.validUntil, ""]} numbers={[2]} empty={texts.noOrders}>
      {props.orders.map(({ order, state, liability }) => (
        <tr key={order.hash}>
          <td><Name text={order.hash} href={liability ? `#/job/${liability}` : `#/order/${order.hash}`} /></td>
          <td>{texts.orderState[state]}</td>
          <td class="right"><Money units={order.cost} token={market.token} /></td>
          <td>{texts.block(order.deadline)}</td>
          <td>
            {state === "open" && account?.address === order.signer ? (
              <Action class="button small quietly" run={async () => { await withdraw(order, account); props.changed(); }}>{texts.withdraw}</Action>
            ) : null}
          </td>
        </tr>
      ))}
    </Table>
  );
}

/** Jobs as rows: what, who, for how much, how it ended. */
export function JobTable(props: { liabilities: Liability[] }) {
  if (!props.liabilities.length) return <p class="quiet">{texts.noJobs}</p>;
  return <ul class="rows" aria-label={texts.jobs}>{props.liabilities.map((liability) => <JobRow key={liability.address} liability={liability} />)}</ul>;
}

/** The latest jobs of an account, which stay up to date. */
export function LatestJobs(props: { of: string }) {
  const jobs = useData<{ liabilities: Liability[] }>(`liabilities?party=${props.of}&limit=20`, "chain");
  return <Show of={jobs}>{({ liabilities }) => <JobTable liabilities={liabilities} />}</Show>;
}

function JobRow({ liability }: { liability: Liability }) {
  const { robotAt, account } = useApp();
  const title = useModel(liability.model)?.description?.title;
  const robot = robotAt(liability.promisor);
  const mine = account?.address === liability.promisee;
  return (
    <li title={liability.address}>
      <a href={`#/job/${liability.address}`} class="list-row">
        <Picture address={liability.promisor} cid={robot?.profile?.picture} size="small" />
        <span class="who"><strong>{title ? plain(title, 60) : texts.job}</strong><span class="quiet">{robot ? nameOf(robot) : short(liability.promisor)}{mine ? "" : ` · ${texts.for} ${short(liability.promisee)}`}</span></span>
        <JobState state={liability.state} />
        <span class="price-tag"><Money units={liability.cost} token={liability.token} /></span>
      </a>
    </li>
  );
}

export function JobState(props: { state: Liability["state"] }) {
  const kinds = { open: "calm", paid: "good", failed: "bad", "called-off": "warn" } as const;
  return <Badge kind={kinds[props.state]}>{texts.jobState[props.state]}</Badge>;
}

export function StatementList(props: { statements: PostedOrder["statements"] }) {
  if (!props.statements.length) return null;
  return (
    <ul class="statements">
      {props.statements.map((one) => (
        <li key={`${one.agent}${one.at}`}>
          <Badge kind="warn">{texts.statement[one.kind]}</Badge> <Name text={one.agent} /> {clock(one.at)}: <Strange text={one.detail} most={500} />{" "}
          <code>{one.code}</code>
        </li>
      ))}
    </ul>
  );
}
