// The client of the daemon: ipfs-api, as pages of 2018 had it, or the ipfs-http-client at a path, for today's daemons.

async function open(url, httpClient) {
  if (httpClient) {
    const { create } = await import(httpClient)
    const ipfs = create({ url })
    return { ipfs, add: async (bytes) => String((await ipfs.add(bytes)).cid) }
  }
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
  return { ipfs, add }
}

module.exports = { open }
