// Foxglove's own client and decoders: each message of a server as a line of JSON; sets gains once.
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { WebSocket } = require("ws");

const client = new FoxgloveClient({ ws: new WebSocket(process.argv[2], ["foxglove.sdk.v1"]) });
const topics = new Map();
let states = 0;

function tell(...what) {
  const plain = (_, value) => (ArrayBuffer.isView(value) ? [...value] : value);
  console.log(JSON.stringify(what, plain));
}

client.on("advertise", (channels) => {
  for (const { id, topic, schema, encoding, schemaEncoding } of channels) {
    if (encoding !== "cdr" || schemaEncoding !== "ros2msg") tell("error", topic, encoding, schemaEncoding);
    topics.set(client.subscribe(id), [topic, new MessageReader(parse(schema, { ros2: true }))]);
  }
  tell("advertised");
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const [topic, reader] = topics.get(subscriptionId);
  tell(topic, reader.readMessage(data), String(timestamp));
  if (topic === "/joint_states" && ++states === 8) {
    client.setParameters([{ name: "Kp", value: [80, 90.5] }, { name: "Kn", value: [3] }], "set");
  }
});
client.on("parameterValues", ({ parameters }) => tell("parameters", parameters));
client.on("error", (error) => tell("error", String(error)));
client.on("close", () => process.exit());
