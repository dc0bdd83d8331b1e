"""Readers of logs, one file per format; each returns a `Table` or `ChannelLog`s."""
