import assert from "node:assert/strict";
import test from "node:test";
import { cidOf, encodeBase58, isCid, parseCid } from "../src/cid";

/** What schemas.unixfs.cid_of_bytes gives for this many bytes, each its place modulo 251. */
const CIDS: Record<number, string> = {
  0: "QmbFMke1KXqnYyBBWxB74N4c5SBnJMVAiMNRcGu6x1AwQH",
  1: "QmS9JArPwa55ePgDnyg6TzX24mYTS1b1vLqWNebyVotKxQ",
  100: "Qmc79UcrLnTXJkkgneodRrovzxKvYzHdyJx675X5iAjkVr",
  262143: "QmRfm83kqBpGJbGxJg1en9hpwq8eNnP4E2Dj8K73F4m983",
  262144: "QmeqfRyS3vkku7n6krqC3DgGMex3x2sCpSeKMDmrG13QQq",
  262145: "QmUSjGawaz4ptvREcMKSMJneWCa5j8dAz2wSAAvHtW2rnB",
  786432: "QmSuzytMNMmTQC6hL7FG7CtoqWKoZpDiMHbcGeoDakJvAg",
  45613057: "QmTedsTekQQkgACJXb1sPZSW8bLdS9LPMrT7L4YdjNRd4n",
};

test("files of all shapes have the CIDs that IPFS gives them", async () => {
  for (const [size, cid] of Object.entries(CIDS)) {
    const data = new Uint8Array(Number(size)).map((_, place) => place % 251);
    assert.equal(await cidOf(data), cid, size);
  }
});

test("only a CIDv0 is a CID", () => {
  const cid = Object.values(CIDS)[0];
  assert.equal(encodeBase58(parseCid(cid)), cid);
  for (const other of ["", cid.slice(1), cid + "1", cid.replace("Q", "0"), "1".repeat(46), "z".repeat(46)]) {
    assert.equal(isCid(other), false, other);
  }
});
