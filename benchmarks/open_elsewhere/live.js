// node live.js URL: all topics of a live connection, from the first on, until standard input ends.
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const WebSocket = require("ws");
const { reader, say } = require("./decode.js");

// The protocol's name since the client was published last; its messages are the same.
const client = new FoxgloveClient({ ws: new WebSocket(process.argv[2], ["foxglove.sdk.v1"]) });
const readers = new Map();
client.on("error", (error) => { throw error; });
client.on("serverInfo", ({ name, capabilities }) => say({ server: name, capabilities }));
client.on("advertise", (channels) => {
  for (const c of channels) {
    readers.set(client.subscribe(c.id), [c.topic, reader(c.encoding, c.schemaEncoding, c.schema)]);
    say({ channel: c.topic, schema: c.schemaName, encoding: c.encoding });
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const [topic, read] = readers.get(subscriptionId);
  say({ topic, time: timestamp, message: read(data) });
});
process.stdin.on("end", () => process.exit(0)).resume();
