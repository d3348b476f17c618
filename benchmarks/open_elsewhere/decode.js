// Channels to readers, as Foxglove makes them; results as lines of JSON.
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");

function reader(encoding, schemaEncoding, schema) {
  if (encoding === "json") return (data) => JSON.parse(new TextDecoder().decode(data));
  if (encoding !== "cdr" || schemaEncoding !== "ros2msg") throw new Error(`${encoding}, ${schemaEncoding}`);
  const ros = new MessageReader(parse(schema, { ros2: true }));
  return (data) => ros.readMessage(data);
}

// Shortest digits that give the same number back; integers of 64 bits as text.
const plain = (_, v) => (typeof v === "bigint" ? v.toString() : ArrayBuffer.isView(v) ? Array.from(v) : v);
const say = (what) => process.stdout.write(`${JSON.stringify(what, plain)}\n`);
module.exports = { reader, say };
