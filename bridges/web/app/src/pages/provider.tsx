import { useState } from "preact/hooks";
import { useApp, useData } from "../app";
import { calls } from "../contracts";
import { amount, duration, ether } from "../format";
import { parseAmount } from "../numbers";
import { texts } from "../texts";
import type { AccountState, Lighthouse as Turns, Order } from "../types";
import { Action, Badge, Facts, Money, Name, NumberField, Show, Strange, Table, WordField } from "../ui";

/** The lighthouse for those who run it: providers, turns, gas and earnings, stakes, the order book. */
export function Lighthouse() {
  const { market, account } = useApp();
  const lighthouse = useData<Turns>("lighthouse", "chain");
  const orders = useData<{ orders: Order[]; dropped: number }>("orders?limit=100", "chain");
  return (
    <>
      <Show of={lighthouse}>
        {(known) => (
          <>
            <Facts
              of={[
                [texts.lighthouse, <><Strange text={known.name} /> <Name text={known.address} /></>],
                [texts.minimalStake, <Money units={known.minimalStake} token={market.xrt} />],
                [texts.turnLength, texts.blocks(known.timeoutBlocks)],
                [texts.hasTurn, <Name text={known.current} />],
                [texts.quotaLeft, known.quotaLeft],
                [texts.gasPrice, ether(known.gasPrice)],
              ]}
            />
            <h2>{texts.providers}</h2>
            <Table label={texts.providers} head={[texts.account, texts.stake, texts.quota, texts.turn, texts.bookOrders, texts.contractsMade, texts.feesAndMinted, texts.gasSpent]} numbers={[1, 2]} empty={texts.noProviders}>
              {known.providers.map((provider) => (
                <tr key={provider.address}>
                  <td><Name text={provider.address} href={`#/account/${provider.address}`} /></td>
                  <td class="right"><Money units={provider.stake} token={market.xrt} /></td>
                  <td class="right">{provider.quota}</td>
                  <td>{provider.hasTurn ? <Badge kind="good">{texts.itsTurn}</Badge> : ""}</td>
                  <td>{provider.status?.market?.openOrders ?? "—"}</td>
                  <td>{provider.status?.market ? `${provider.status.market.created} / ${provider.status.market.finalized}` : "—"}</td>
                  <td>{provider.status?.market ? `${amount(provider.status.market.fees, market.xrt)} + ${amount(provider.status.market.minted, market.xrt)}` : "—"}</td>
                  <td>{provider.status?.market ? ether(provider.status.market.spent) : "—"}</td>
                </tr>
              ))}
            </Table>
            <h2>{texts.yourStake}</h2>
            {account?.kind === "wallet" ? <Stake lighthouse={known} address={account.address} changed={lighthouse.reload} /> : <p class="callout">{texts.stakeNeedsWallet}</p>}
          </>
        )}
      </Show>
      <h2>{texts.orderBook}</h2>
      <Show of={orders}>
        {({ orders: open }) => (
          <Table label={texts.orderBook} head={[texts.order, texts.what, texts.by, texts.price, texts.model, texts.validUntil]} numbers={[3]} empty={texts.noOrders}>
            {open.map((order) => (
              <tr key={order.hash}>
                <td><Name text={order.hash} href={`#/order/${order.hash}`} /></td>
                <td><span class={`kind ${order.kind}`}>{texts.eventName[order.kind]}</span></td>
                <td><Name text={order.signer} /></td>
                <td class="right">{amount(order.cost, market.token)}</td>
                <td><Name text={order.model} /></td>
                <td>{texts.block(order.deadline)}</td>
              </tr>
            ))}
          </Table>
        )}
      </Show>
    </>
  );
}

function Stake(props: { lighthouse: Turns; address: string; changed: () => void }) {
  const { market, send, notify } = useApp();
  const state = useData<AccountState>(`accounts/${props.address}`);
  const [value, setValue] = useState("");
  const units = parseAmount(value, market.xrt.decimals);
  const done = (text: string) => {
    notify(text);
    state.reload();
    props.changed();
  };
  const stake = async () => {
    // The contract that takes the stake is the lighthouse; it needs an allowance of its own.
    await send(market.xrt.address, calls.approve(props.lighthouse.address, units!));
    await send(props.lighthouse.address, calls.refill(units!));
    done(texts.staked);
  };
  const takeBack = async () => {
    await send(props.lighthouse.address, calls.withdraw(units!));
    done(texts.stakeWithdrawn);
  };
  return (
    <>
      <Show of={state}>
        {(known) => <Facts of={[[texts.stake, <Money units={known.stake} token={market.xrt} />], [texts.balance, <Money units={known.xrt.balance} token={market.xrt} />], [texts.gas, ether(known.eth)]]} />}
      </Show>
      <div class="row end">
        <NumberField label={texts.stakeAmount} text={value} change={setValue} error={value && units === null ? texts.notAnAmount : ""} />
        <Action id="stake" class="button" disabled={!units} run={stake}>{texts.stakeButton}</Action>
        <Action id="unstake" class="button quietly" disabled={!units} run={takeBack}>{texts.withdrawStake}</Action>
      </div>
      <p class="hint">{texts.stakeHint}</p>
      <CreateLighthouse done={done} />
    </>
  );
}

function CreateLighthouse(props: { done: (text: string) => void }) {
  const { market, send } = useApp();
  const [name, setName] = useState("");
  const [stake, setStake] = useState("1");
  const [blocks, setBlocks] = useState("10");
  const units = parseAmount(stake, market.xrt.decimals);
  const turn = parseAmount(blocks, 0);
  const create = async () => {
    await send(market.factory, calls.createLighthouse(units!, turn!, name));
    props.done(texts.lighthouseCreated(name));
  };
  return (
    <details class="more">
      <summary>{texts.createLighthouse}</summary>
      <div class="fields">
        <WordField label={texts.name} hint={texts.lighthouseNameHint} text={name} change={setName} />
        <NumberField label={texts.minimalStake} text={stake} change={setStake} error={units === null ? texts.notAnAmount : ""} />
        <NumberField label={texts.turnLength} text={blocks} change={setBlocks} error={turn ? "" : texts.notBlocks} hint={turn ? duration(Number(turn) * market.blockTime) : ""} />
      </div>
      <Action disabled={!name || !units || !turn} run={create}>{texts.createLighthouse}</Action>
    </details>
  );
}
