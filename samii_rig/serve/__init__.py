"""The service: recordings, runs and live data over HTTP and WebSocket, for a lab's network."""
