"""The page: a web server with which people order work, watch it and judge it in a browser."""
