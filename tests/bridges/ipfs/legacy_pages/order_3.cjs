// Run by node: order a job with robonomics-js 0.3.0 and its own IPFS provider, as a page of 2018 did.
//
//     NODE_PATH=… node order_3.cjs NODE_URL ENS IPFS_URL MODEL OBJECTIVE [JS_IPFS_PACKAGES]
const [url, ens, ipfsUrl, model, content, packages] = process.argv.slice(2)

// The client waits 3 to 10 s between two looks at the chain.
const later = global.setTimeout
const again = global.setInterval
global.setTimeout = (work, ms, ...rest) => later(work, ms / 20, ...rest)
global.setInterval = (work, ms, ...rest) => again(work, ms / 20, ...rest)

require('regenerator-runtime/runtime')
const Web3 = require('web3')
const { open } = require('./ipfs.cjs')
Promise.join = require('bluebird').join
const { default: Robonomics, MessageProviderIpfsApi } = require('robonomics-js')

const report = (name, value) => console.log(JSON.stringify({ name, value }))

async function main() {
  const web3 = new Web3(new Web3.providers.HttpProvider(url))
  const account = web3.eth.accounts[2]
  const { ipfs, add, heard } = await open(ipfsUrl, packages)
  report('daemon', [(await ipfs.version()).version, (await ipfs.id()).id])
  const hash = await add(Buffer.from(content, 'base64'))
  const provider = new MessageProviderIpfsApi(ipfs)
  const robonomics = new Robonomics({ web3, account, provider, signPrefix: false, ens })
  await robonomics.ready()
  await robonomics.setLighthouse('airalab')
  await new Promise((resolve, reject) =>
    robonomics.xrt.send('approve', [robonomics.factory.address, 42], { from: account }).then(resolve, reject))
  const offered = new Promise((resolve) => robonomics.getOffer(model, resolve))
  const results = []
  robonomics.getResult((message) => results.push(message.result))
  const terms = { objective: hash, token: robonomics.xrt.address, cost: 42, deadline: web3.eth.blockNumber + 1000 }
  const made = new Promise((resolve) => robonomics.watchLiability(null, resolve))
  // What it returns looks at blocks only from when the demand is sent, and waits for a callback that today's js-ipfs does
  // not call.
  await heard()
  robonomics.postDemand(model, terms)
  const liability = await made
  report('liability', liability.address)
  await new Promise((resolve) => liability.watchResult(resolve))
  // It asks for each member by itself: what it passed on may have been read partly before the job's end.
  const { result } = await liability.getInfo()
  report('result', result)
  report('offer', (await offered).account)
  while (!results.includes(result)) await new Promise((resolve) => setTimeout(resolve, 100))
  report('result message', result)
}

main().then(() => process.exit(0), (error) => { console.error(error); process.exit(1) })
