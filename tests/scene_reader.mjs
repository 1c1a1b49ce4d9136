// The visuals of a scene by @mcap/core, Foxglove's decoders, urdf-loader and three.js; argument: the MCAP file.
// The last line is JSON for the last joint state: its positions, and the vertices of each link in the root frame, placed by the
// joint state ("joints") and by the transforms ("tf").
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { McapStreamReader } from "@mcap/core";
import { DOMParser, Document, Element } from "linkedom";
import { LoadingManager, Matrix4, Quaternion, Vector3 } from "three";
import URDFLoader from "urdf-loader";

const require = createRequire(import.meta.url);
const { parse } = require("@foxglove/rosmsg"), { MessageReader } = require("@foxglove/rosmsg2-serialization");
Object.assign(globalThis, { DOMParser, Document, Element, ProgressEvent: Event });
globalThis.fetch = async ({ url }) => new Response(await readFile(new URL(url))); // Node.js fetches no file

const file = new McapStreamReader(), schemas = new Map(), channels = new Map(), messages = new Map();
file.append(await readFile(process.argv[2]));
for (let record; (record = file.nextRecord()); ) {
  if (record.type === "Schema") schemas.set(record.id, new TextDecoder().decode(record.data));
  if (record.type === "Channel") channels.set(record.id, [record.topic, new MessageReader(parse(schemas.get(record.schemaId), { ros2: true }))]);
  if (record.type !== "Message") continue;
  const [topic, reader] = channels.get(record.channelId);
  messages.set(topic, [...(messages.get(topic) ?? []), reader.readMessage(record.data)]);
}

const manager = new LoadingManager();
const loaded = new Promise((resolve, reject) => Object.assign(manager, { onLoad: resolve, onError: reject }));
const robot = new URDFLoader(manager).parse(messages.get("/robot_description")[0].data);
await loaded;

const { name, position } = messages.get("/joint_states").at(-1);
name.forEach((joint, i) => robot.setJointValue(joint, position[i]));
robot.updateMatrixWorld(true);
const transforms = [...messages.get("/tf_static"), messages.get("/tf").at(-1)].flatMap((message) => message.transforms);
const tf = new Map(transforms.map(({ header, child_frame_id: child, transform: { translation: t, rotation: r } }) =>
  [child, [header.frame_id, new Matrix4().compose(new Vector3(t.x, t.y, t.z), new Quaternion(r.x, r.y, r.z, r.w), new Vector3(1, 1, 1))]]));
const frame = (link) => (tf.has(link) ? frame(tf.get(link)[0]).multiply(tf.get(link)[1]) : new Matrix4());

function vertices(link, placement) {
  const inLink = placement.multiply(link.matrixWorld.clone().invert()), found = new Map();
  for (const visual of link.children.filter((child) => child.isURDFVisual)) visual.traverse((mesh) => {
    const points = mesh.geometry?.getAttribute("position"), placed = inLink.clone().multiply(mesh.matrixWorld);
    for (let i = 0; i < (points?.count ?? 0); i++) {
      const point = new Vector3().fromBufferAttribute(points, i).applyMatrix4(placed).toArray();
      found.set(point.join(), point);
    }
  });
  return [...found.values()];
}

const all = (placement) => Object.fromEntries(Object.entries(robot.links).map(([link, node]) => [link, vertices(node, placement(link, node))]));
const placed = { joints: all((_, node) => node.matrixWorld.clone()), tf: all(frame) };
console.log(JSON.stringify({ q: Object.fromEntries(name.map((joint, i) => [joint, position[i]])), ...placed }));
