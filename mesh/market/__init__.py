"""The market of a lighthouse: the order book, and the provider that serves it (which needs a chain: import it from
`mesh.market.provider`)."""

from mesh.market.book import Added, Match, OrderBook, order_id
