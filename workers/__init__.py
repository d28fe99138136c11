"""Where it runs: processes, messages and sockets; no mathematics."""
