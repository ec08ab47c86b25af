// Run by node: order a job with robonomics-js 0.6.3 and its own IPFS provider, as a page of 2019 did.
//
//     NODE_PATH=… node order_5.cjs NODE_URL ENS IPFS_URL MODEL OBJECTIVE [JS_IPFS_PACKAGES]
const [url, ens, ipfsUrl, model, content, packages] = process.argv.slice(2)

require('regenerator-runtime/runtime')
const Web3 = require('web3')
const { open } = require('./ipfs.cjs')
const { default: Robonomics, MessageProviderIpfs, MessageProviderIpfsApi, Account } = require('robonomics-js')

const report = (name, value) => console.log(JSON.stringify({ name, value }))

async function main() {
  const web3 = new Web3(new Web3.providers.WebsocketProvider(url.replace('http', 'ws')))
  const address = (await web3.eth.getAccounts())[2]
  const { ipfs, add, heard } = await open(ipfsUrl, packages)
  const hash = await add(Buffer.from(content, 'base64'))
  const Provider = ipfsUrl.startsWith('http') ? MessageProviderIpfsApi : MessageProviderIpfs
  const robonomics = new Robonomics({
    web3, account: { address, isSignPrefix: false }, ens: { address: ens }, lighthouse: 'airalab',
    messageProvider: new Provider(ipfs)
  })
  robonomics.account.setSigner((message) => web3.eth.sign(message, address))
  await robonomics.ready()
  await robonomics.xrt.methods.approve(robonomics.factory.address, 42).send({ from: address, gas: 3000000 })
  const offered = new Promise((resolve) => robonomics.onOffer(model, resolve))
  const results = []
  robonomics.onResult((message) => results.push(message.result))
  // What its `sendDemand` returns subscribes to contracts only when the demand is sent: a quick market has made it by then.
  const made = new Promise((resolve, reject) =>
    robonomics.onLiability((error, liability) => error ? reject(error) : resolve(liability)))
  await heard()
  await robonomics.sendDemand({
    model, objective: hash, token: robonomics.xrt.address, lighthouse: robonomics.lighthouse.address, cost: 42,
    deadline: 100000000
  }, false)
  const liability = await made
  report('liability', liability.address)
  // The job may have ended before the page could subscribe to its end.
  while (!(await liability.getInfo()).isFinalized) await new Promise((resolve) => setTimeout(resolve, 100))
  const { result } = await liability.getInfo()
  report('result', result)
  report('offer', Account.recoveryMessage(await offered))
  while (!results.includes(result)) await new Promise((resolve) => setTimeout(resolve, 100))
  report('result message', result)
}

main().then(() => process.exit(0), (error) => { console.error(error); process.exit(1) })
