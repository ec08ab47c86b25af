// Run by node: print the CIDs that ipfs-unixfs-importer gives to the beginnings of one file, a JSON list.
//
//     node importer_names.mjs IMPORTER FILE < JSON list of sizes
//
// IMPORTER is the package's entry point. Nothing is kept.
import { readFileSync } from 'node:fs'

const [importerPath, file] = process.argv.slice(2)
const { importer } = await import(importerPath)
const content = readFileSync(file)
const nowhere = { put: async (cid) => cid, get: async () => { throw new Error('nothing is kept') } }
const settings = { cidVersion: 0, rawLeaves: false, chunker: 'fixed', maxChunkSize: 262144, onlyHash: true }

const names = []
for (const size of JSON.parse(readFileSync(0))) {
  const source = [{ path: 'file', content: [content.subarray(0, size)] }]
  for await (const entry of importer(source, nowhere, settings)) names.push(entry.cid.toString())
}
console.log(JSON.stringify(names))
