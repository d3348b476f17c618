// node file.js RECORDING: every message of an MCAP file, by its index.
const { open } = require("node:fs/promises");
const { McapIndexedReader } = require("@mcap/core");
const { FileHandleReadable } = require("@mcap/nodejs");
const { loadDecompressHandlers } = require("@mcap/support");
const { reader, say } = require("./decode.js");

(async () => {
  const file = await open(process.argv[2]);
  const mcap = await McapIndexedReader.Initialize({
    readable: new FileHandleReadable(file),
    decompressHandlers: await loadDecompressHandlers(),
  });
  const readers = new Map();
  for (const c of mcap.channelsById.values()) {
    const schema = mcap.schemasById.get(c.schemaId), text = new TextDecoder().decode(schema.data);
    readers.set(c.id, [c.topic, reader(c.messageEncoding, schema.encoding, text)]);
    say({ channel: c.topic, schema: schema.name, encoding: c.messageEncoding, metadata: Object.fromEntries(c.metadata) });
  }
  for await (const m of mcap.readMessages()) {
    const [topic, read] = readers.get(m.channelId);
    say({ topic, time: m.logTime, message: read(m.data) });
  }
  for await (const a of mcap.readAttachments()) say({ attachment: a.name, text: new TextDecoder().decode(a.data) });
  await file.close();
})();
