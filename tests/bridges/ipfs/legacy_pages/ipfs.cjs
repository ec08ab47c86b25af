// What a page reaches IPFS by: ipfs-api, as in 2018, with a daemon at `url`; or what belongs to today's js-ipfs, from the
// folder of its packages: its client with a daemon at `url`, or a node in the page that connects to the swarm address.
const { mkdtempSync } = require('fs')
const { tmpdir } = require('os')
const { join } = require('path')

async function open(url, packages) {
  if (!packages) return opened2018(url)
  const isClient = url.startsWith('http')
  const ipfs = await (isClient ? client(url, packages) : node(url, packages))
  const add = async (bytes) => String((await ipfs.add(bytes)).cid)
  return { ipfs, add, heard: () => isClient ? null : heard(ipfs) }
}

// Wait until the node at the other end says that it listens to what this one does: what is sent before reaches nobody.
async function heard(ipfs) {
  for (;;) {
    const topics = await ipfs.pubsub.ls()
    const peers = await Promise.all(topics.map((topic) => ipfs.pubsub.peers(topic)))
    if (peers.length && peers.every((known) => known.length)) return
    await new Promise((resolve) => setTimeout(resolve, 100))
  }
}

async function client(url, packages) {
  const { create } = await import(join(packages, 'ipfs-http-client/src/index.js'))
  return create({ url })
}

async function node(address, packages) {
  const { create } = await import(join(packages, 'ipfs-core/src/index.js'))
  const { multiaddr } = await import(join(packages, '@multiformats/multiaddr/dist/src/index.js'))
  const Discovery = { MDNS: { Enabled: false }, webRTCStar: { Enabled: false } }
  const Addresses = { Swarm: ['/ip4/127.0.0.1/tcp/0'], Delegates: [] }
  const repo = mkdtempSync(join(tmpdir(), 'page-'))
  const ipfs = await create({ repo, silent: true, config: { Addresses, Bootstrap: [], Discovery } })
  await ipfs.swarm.connect(multiaddr(address))
  return ipfs
}

function opened2018(url) {
  const IPFS = require('ipfs-api')
  const { hostname, port } = new URL(url)
  const ipfs = new IPFS(hostname, port)
  const add = async (content) => {
    const [{ hash }] = await ipfs.add(content)
    for (const bytes of [await ipfs.cat(hash), (await ipfs.get(hash))[0].content]) {
      if (!bytes.equals(content)) throw new Error('other bytes came back')
    }
    return hash
  }
  return { ipfs, add, heard: () => null }
}

module.exports = { open }
