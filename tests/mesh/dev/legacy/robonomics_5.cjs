// Run by node: use each function of robonomics-js 0.6.3 on a development chain, and print what it gave as JSON lines.
//
//     NODE_PATH=…/node_modules node robonomics_5.cjs WEBSOCKET_URL ENS
//
// Messages go from instance to instance in this process. Nobody has a private key here: the node signs for all.
const [url, ens] = process.argv.slice(2)

require('regenerator-runtime/runtime')
const Web3 = require('web3')
const { default: Robonomics, MessageProviderAbstract, Messenger, Token, Account, utils } = require('robonomics-js')

const report = (name, value) => console.log(JSON.stringify({ name, value }))
const hex = (cid) => Web3.utils.bytesToHex(utils.base58.decode(cid))

class Messages extends MessageProviderAbstract {
  ready() { return Promise.resolve(true) }
  send(topic, message) {
    for (const listener of Messages.listeners[topic] || []) listener(message)
    return Promise.resolve(true)
  }
  on(topic, listener) { (Messages.listeners[topic] = Messages.listeners[topic] || []).push(listener) }
  off() {}
}
Messages.listeners = {}

const web3 = new Web3(new Web3.providers.WebsocketProvider(url))
const MODEL = 'QmfCcLKrTCuXsf6bHbVupVv4zsbs6kjqTQ7DRftGqMLjdW'
const OBJECTIVE = 'Qmbm3o2wkqseSEi5F69CPAuDrsKnrwTJ3HN5FVLPgLHKUm'
const RESULT = 'QmWboFP8XeBtFMbNYK3Ne8Z3gKFBSR5iQzkKgeNgQz3dZ4'
const STAKE = 100000000000

const order = (message, fee, ...parties) => web3.eth.abi.encodeParameters(
  ['bytes', 'bytes', 'address', 'uint256', 'address', 'address', 'uint256', 'uint256', 'address', 'bytes'],
  [hex(message.model), hex(message.objective), message.token, message.cost, ...parties, fee, message.deadline,
    message.sender, message.signature]
)

// The provider of these instances: it matches the last demand and the last offer, and finalizes by results.
const provide = (robonomics) => {
  let demand = null
  let offer = null
  const { methods } = robonomics.lighthouse
  const from = robonomics.account.address
  const match = () => {
    if (demand === null || offer === null) return
    const [one, other] = [demand, offer]
    demand = offer = null
    methods.createLiability(
      order(one, one.validatorFee, one.lighthouse, one.validator),
      order(other, other.lighthouseFee, other.validator, other.lighthouse)
    ).send({ from, gas: 2000000 })
  }
  robonomics.onDemand(MODEL, (message) => { demand = message; match() })
  robonomics.onOffer(null, (message) => { offer = message; match() })
  robonomics.onResult((message) => {
    methods.finalizeLiability(message.liability, hex(message.result), message.success, message.signature)
      .send({ from, gas: 2000000 })
  })
}

async function main() {
  const [providerAccount, robotAccount, personAccount] = await web3.eth.getAccounts()
  report('accounts', (await web3.eth.getAccounts()).length)
  report('coinbase', await web3.eth.getCoinbase())
  const open = async (address) => {
    const robonomics = new Robonomics({
      web3, account: { address, isSignPrefix: false }, ens: { address: ens }, messageProvider: new Messages(), lighthouse: 'airalab'
    })
    robonomics.account.setSigner((message) => web3.eth.sign(message, address))
    await robonomics.ready()
    return robonomics
  }
  const [provider, robot, person] = await Promise.all([providerAccount, robotAccount, personAccount].map(open))
  const send = (method, from) => method.send({ from, gas: 3000000 })

  const watched = new Promise((resolve, reject) => {
    const watcher = provider.factory.onLighthouse((error, lighthouse) => {
      if (error) return reject(error)
      watcher.unsubscribe()
      resolve(lighthouse)
    })
    watcher.on('connected', () => {
      // No gas is given: the node estimates it.
      provider.factory.methods.createLighthouse(1000, 25, 'legacy5').send({ from: providerAccount })
    })
  })
  report('watched lighthouse', (await watched).name)
  for (const one of [provider, robot, person]) await one.initLighthouse('legacy5')
  const { lighthouse } = provider
  report('lighthouse', lighthouse.name)
  report('token', await provider.xrt.getInfo())
  report('another token', await new Token(web3, provider.xrt.address).getInfo())
  const approved = await send(provider.xrt.methods.approve(lighthouse.address, STAKE), providerAccount)
  report('receipt', (await utils.watchTx(web3, approved.transactionHash)).status)
  report('allowance', Number(await provider.xrt.methods.allowance(providerAccount, lighthouse.address).call()))
  await send(lighthouse.methods.refill(STAKE), providerAccount)
  report('providers', (await lighthouse.getProviders()).map((address) => address === providerAccount))
  report('staked', Number(await lighthouse.methods.stakes(providerAccount).call()))
  await send(lighthouse.methods.withdraw(STAKE / 2), providerAccount)
  report('staked after withdrawal', Number(await lighthouse.methods.stakes(providerAccount).call()))
  const { minimalStake, timeoutInBlocks } = await lighthouse.getInfo()
  report('lighthouse info', { minimalStake, timeoutInBlocks })

  await send(person.xrt.methods.approve(person.factory.address, 2000), personAccount)
  const before = Number(await robot.xrt.methods.balanceOf(robotAccount).call())
  const nonce = Number(await person.factory.methods.nonceOf(personAccount).call())
  provide(provider)
  const seen = []
  const listeners = [
    person.onOffer(MODEL, (message) => seen.push(['offer', Account.recoveryMessage(message) === robotAccount])),
    robot.onDemand(MODEL, (message) => seen.push(['demand', Account.recoveryMessage(message) === personAccount])),
    person.onResult((message) => seen.push(['result', Account.recoveryMessage(message) === robotAccount]))
  ]
  const orders = () => ({
    model: MODEL, objective: OBJECTIVE, token: person.xrt.address, lighthouse: lighthouse.address, cost: 1000, deadline: 100000000
  })
  const [liability, same] = await Promise.all([person.sendDemand(orders()), robot.sendOffer(orders())])
  report('one liability', liability.address === same.address)
  report('nonce', Number(await person.factory.methods.nonceOf(personAccount).call()) - nonce)
  report('worker', liability.worker === providerAccount)
  const result = liability.onResult()
  // The subscription is sent before the result, on the same socket.
  await robot.sendResult({ liability: liability.address, result: RESULT, success: true })
  report('result', await result)
  report('read result', await liability.result())
  const info = await liability.getInfo()
  report('info', {
    model: info.model,
    objective: info.objective,
    result: info.result,
    cost: info.cost,
    parties: [info.promisee === personAccount, info.promisor === robotAccount],
    lighthouse: info.lighthouse === lighthouse.address,
    isSuccess: info.isSuccess,
    isFinalized: info.isFinalized
  })
  report('paid', Number(await robot.xrt.methods.balanceOf(robotAccount).call()) - before)
  report('messages', seen.sort())
  // Statements of providers, which the mesh's bridge also sends to this network.
  const heard = []
  person.onFeedback((message) => heard.push(['feedback', message.accepted]))
  person.onPending((message) => heard.push(['pending', message.tx]))
  Messages.listeners[lighthouse.name].forEach((listener) => {
    listener(Buffer.from(JSON.stringify({ order: '0x01', accepted: true, signature: '0x02' })))
    listener(Buffer.from(JSON.stringify({ tx: '0x03' })))
  })
  report('statements', [...new Set(heard.map(JSON.stringify))].sort())
  listeners.forEach((listener) => person.messenger.off(listener))
  report('created by type', Messenger.create(Messenger.TYPE_RESULT, { liability: '0x', result: RESULT, success: true }).success)
}

main().then(() => process.exit(0), (error) => { console.error(error); process.exit(1) })
