// Run by node: use each function of robonomics-js 0.3.0 on a development chain, and print what it gave as JSON lines.
//
//     NODE_PATH=…/node_modules node robonomics_3.cjs HTTP_URL ENS
//
// Messages go from instance to instance in this process. Nobody has a private key here: the node signs for all.
const [url, ens] = process.argv.slice(2)

// The client waits 3 to 10 s between two looks at the chain.
const later = global.setTimeout
const again = global.setInterval
global.setTimeout = (work, ms, ...rest) => later(work, ms / 50, ...rest)
global.setInterval = (work, ms, ...rest) => again(work, ms / 50, ...rest)

require('regenerator-runtime/runtime')
const Web3 = require('web3')
const base58 = require('base-58')
// Lighthouse.getInfo of this version calls Promise.join without importing bluebird: pages had it as their Promise.
Promise.join = require('bluebird').join
const { default: Robonomics, MessageProviderAbstract, Token, utils } = require('robonomics-js')

const { abi, utils: web3Utils } = utils.web3Beta
const hex = (cid) => web3Utils.bytesToHex(base58.decode(cid))
const report = (name, value) => console.log(JSON.stringify({ name, value }))

class Messages extends MessageProviderAbstract {
  ready() { return Promise.resolve(true) }
  push(topic, message) {
    for (const listener of Messages.listeners[topic] || []) listener(message)
    return Promise.resolve(true)
  }
  watch(topic, listener) { (Messages.listeners[topic] = Messages.listeners[topic] || []).push(listener) }
}
Messages.listeners = {}

const web3 = new Web3(new Web3.providers.HttpProvider(url))
const [providerAccount, robotAccount, personAccount] = web3.eth.accounts
const open = async (account, more = {}) => {
  const robonomics = new Robonomics({ web3, account, provider: new Messages(), signPrefix: false, ens, ...more })
  await robonomics.ready()
  return robonomics
}
const mined = async (hash) => {
  for (;;) {
    const receipt = web3.eth.getTransactionReceipt(hash)
    if (receipt !== null) {
      if (Number(receipt.status) !== 1) throw new Error(`${hash} failed`)
      return receipt
    }
    await new Promise((resolve) => setTimeout(resolve, 1000))
  }
}
const MODEL = 'QmfCcLKrTCuXsf6bHbVupVv4zsbs6kjqTQ7DRftGqMLjdW'
const OBJECTIVE = 'Qmbm3o2wkqseSEi5F69CPAuDrsKnrwTJ3HN5FVLPgLHKUm'
const RESULT = 'QmWboFP8XeBtFMbNYK3Ne8Z3gKFBSR5iQzkKgeNgQz3dZ4'
const STAKE = 100000000000

const order = (message, fee, ...parties) => abi.encodeParameters(
  ['bytes', 'bytes', 'address', 'uint256', 'address', 'address', 'uint256', 'uint256', 'bytes32', 'bytes'],
  [hex(message.model), hex(message.objective), message.token, message.cost, ...parties, fee, message.deadline,
    message.nonce, message.signature]
)

// The provider of these instances: it matches the last demand and the last offer, and finalizes by results.
const provide = (robonomics) => {
  let demand = null
  let offer = null
  const lighthouse = robonomics.lighthouse.address
  const builder = web3.eth.contract(robonomics.factory.contract.abi).at(lighthouse)
  const match = () => {
    if (demand === null || offer === null) return
    const [one, other] = [demand, offer]
    demand = offer = null
    builder.createLiability(
      order(one, one.validatorFee, one.lighthouse, one.validator),
      order(other, other.lighthouseFee, other.validator, other.lighthouse),
      { from: robonomics.account, gas: 2000000 }, (error) => { if (error) throw error })
  }
  robonomics.getDemand(MODEL, (message) => { demand = message; match() })
  robonomics.getOffer(MODEL, (message) => { offer = message; match() })
  robonomics.getResult(async (message) => {
    const call = abi.encodeFunctionCall(
      { name: 'finalize', type: 'function', inputs: ['bytes', 'bool', 'bytes', 'bool'].map((type, at) => ({ type, name: `a${at}` })) },
      [hex(message.result), message.success, message.signature, true])
    await robonomics.lighthouse.send('to', [message.liability, call], { from: robonomics.account, gas: 2000000 })
  })
}

async function main() {
  report('coinbase', (await open(undefined)).account === web3.toChecksumAddress(providerAccount))
  const [provider, robot, person] = await Promise.all([providerAccount, robotAccount, personAccount].map((a) => open(a)))

  const found = []
  const lighthouses = provider.factory.watchLighthouse((lighthouse) => found.push(lighthouse.name))
  await new Promise((resolve) => setTimeout(resolve, 5000))
  await mined(await provider.factory.send('createLighthouse', [1000, 25, 'legacy3'], { from: providerAccount }))
  report('lighthouses', (await provider.getLighthouses()).map(({ name }) => name))
  while (!found.length) await new Promise((resolve) => setTimeout(resolve, 1000))
  provider.factory.stop(lighthouses)
  report('watched lighthouse', found)

  for (const one of [provider, robot, person]) await one.setLighthouse('legacy3')
  const lighthouse = provider.lighthouse
  report('token', await provider.xrt.getInfo())
  report('another token', await new Token(web3, provider.xrt.address).getInfo())
  await mined(await provider.xrt.send('approve', [lighthouse.address, STAKE], { from: providerAccount }))
  report('allowance', Number(await provider.xrt.call('allowance', [providerAccount, lighthouse.address])))
  await mined(await lighthouse.send('refill', [STAKE], { from: providerAccount }))
  report('members', (await lighthouse.getMembers()).map((address) => address.toLowerCase() === providerAccount))
  report('staked', Number(await lighthouse.call('balances', [providerAccount])))
  await mined(await lighthouse.send('withdraw', [STAKE / 2], { from: providerAccount }))
  report('staked after withdrawal', Number(await lighthouse.call('balances', [providerAccount])))
  const { minimalFreeze, timeoutBlocks } = await lighthouse.getInfo()
  report('lighthouse', { minimalFreeze, timeoutBlocks })
  report('ens', [await person.ens.addr('xrt') === person.xrt.address, await person.ens.addrLighthouse('legacy3') === lighthouse.address])
  report('model', await person.getModel(MODEL))
  report('markets', await person.getMarkets())

  provide(provider)
  await mined(await person.xrt.send('approve', [person.factory.address, 2000], { from: personAccount }))
  const before = Number(await robot.xrt.call('balanceOf', [robotAccount]))
  const watched = new Set()
  const watcher = person.watchLiability(MODEL, (liability) => watched.add(liability.address))
  await new Promise((resolve) => setTimeout(resolve, 5000))
  const terms = { objective: OBJECTIVE, token: person.xrt.address, cost: 1000, deadline: web3.eth.blockNumber + 1000 }
  const [liability, same] = await Promise.all([person.postDemand(MODEL, { ...terms }), robot.postOffer(MODEL, { ...terms })])
  while (!watched.size) await new Promise((resolve) => setTimeout(resolve, 1000))
  person.factory.stop(watcher)
  report('one liability', [liability.address === same.address, watched.has(liability.address)])
  report('worker', liability.worker.toLowerCase() === providerAccount)
  const result = new Promise((resolve) => liability.watchResult(resolve))
  await robot.postResult({ liability: liability.address, result: RESULT, success: true })
  // The client reads fifteen values at once, not of one block: it may see the end of a job and not yet its result.
  report('result', await result || (await liability.getInfo()).result)
  const info = await liability.getInfo()
  report('info', {
    model: info.model,
    objective: info.objective,
    result: info.result,
    cost: info.cost,
    parties: [info.promisee.toLowerCase() === personAccount, info.promisor.toLowerCase() === robotAccount],
    lighthouse: info.lighthouse === lighthouse.address,
    isSuccess: info.isSuccess,
    isFinalized: info.isFinalized
  })
  report('paid', Number(await robot.xrt.call('balanceOf', [robotAccount])) - before)
}

main().then(() => process.exit(0), (error) => { console.error(error); process.exit(1) })
