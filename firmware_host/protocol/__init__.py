"""The protocol between host and board: its definition, datagrams, requests, and the client."""
