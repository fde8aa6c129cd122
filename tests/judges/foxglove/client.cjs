// Foxglove's own client subscribes to every channel and decodes each message:
//
//     node client.cjs ADDRESS SUBPROTOCOL SECONDS [ORIGIN]
//
// Prints one JSON object a line: what the server says about itself, its channels, then the messages.
const { createRequire } = require("module");
// The packages are in the folder where the judges installed them.
const load = createRequire(`${process.env.FOXGLOVE_PACKAGES}/package.json`);
const { FoxgloveClient } = load("@foxglove/ws-protocol");
const { parse } = load("@foxglove/rosmsg");
const { MessageReader } = load("@foxglove/rosmsg2-serialization");
const { WebSocket } = load("ws");

const [address, subprotocol, seconds, origin] = process.argv.slice(2);
const options = origin ? { origin } : {};
const client = new FoxgloveClient({ ws: new WebSocket(address, [subprotocol], options) });
// A number that JSON does not have becomes a text; 64-bit integers as well.
const plain = (_, value) =>
  typeof value === "bigint" || (typeof value === "number" && !Number.isFinite(value)) ? String(value)
    : ArrayBuffer.isView(value) ? Array.from(value) : value;
const print = (object) => console.log(JSON.stringify(object, plain));
const readers = new Map();

client.on("error", (error) => {
  print({ error: String(error) });
  process.exit(1);
});
client.on("serverInfo", (info) => print({ info }));
client.on("status", (status) => print({ status }));
client.on("advertise", (channels) => {
  print({ channels });
  for (const channel of channels) {
    const reader = new MessageReader(parse(channel.schema, { ros2: true }));
    readers.set(client.subscribe(channel.id), [channel.topic, reader]);
  }
  setTimeout(() => process.exit(0), 1000 * Number(seconds));
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const [topic, reader] = readers.get(subscriptionId);
  print({ topic, time: timestamp, message: reader.readMessage(data) });
});
