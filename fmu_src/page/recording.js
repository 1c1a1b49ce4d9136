/**
 * A session as a ROS 2 bag: an MCAP file of serialised messages, with their provenance.
 *
 * Source: the MCAP specification, version 0. The page has a template of each topic's message.
 */

import { decoded } from "./unpack.js";

/** @typedef {import("./robot.js").Robot} Robot */
/** @typedef {import("./session.js").Session} Session */

const MAGIC = [0x89, 0x4d, 0x43, 0x41, 0x50, 0x30, 0x0d, 0x0a];
const CHUNK = 1 << 20; // bytes
const SECOND = 1000000000n; // ns
const OP = {
  header: 1, footer: 2, schema: 3, channel: 4, message: 5, chunk: 6, messageIndex: 7, chunkIndex: 8,
  statistics: 11, metadata: 12, metadataIndex: 13, dataEnd: 15,
};

/** A growing buffer of little-endian bytes. */
class Bytes {
  constructor() {
    this.view = new DataView(new ArrayBuffer(1024));
    this.length = 0;
  }

  /** @type {(size: number) => number} Reserve a number of bytes; return their offset. */
  room(size) {
    if (this.length + size > this.view.byteLength) {
      const longer = new Uint8Array(2 * (this.length + size));
      longer.set(this.content);
      this.view = new DataView(longer.buffer);
    }
    this.length += size;
    return this.length - size;
  }

  get content() {
    return new Uint8Array(this.view.buffer, 0, this.length);
  }

  /** @type {(size: number, ...values: (number | bigint)[]) => Bytes} Append integers of a size in bits. */
  put(size, ...values) {
    for (const value of values) {
      const at = this.room(size / 8);
      if (size === 64) this.view.setBigUint64(at, BigInt(value), true);
      else if (size === 32) this.view.setUint32(at, Number(value), true);
      else if (size === 16) this.view.setUint16(at, Number(value), true);
      else this.view.setUint8(at, Number(value));
    }
    return this;
  }

  /** @param {Uint8Array | number[]} content */
  raw(content) {
    const at = this.room(content.length);
    new Uint8Array(this.view.buffer).set(content, at);
    return this;
  }

  /** @type {(text: string) => Bytes} Append a text after its length. */
  text(text) {
    const content = new TextEncoder().encode(text);
    return this.put(32, content.length).raw(content);
  }

  /** @type {(opcode: number, content: Bytes) => Bytes} */
  record(opcode, content) {
    return this.put(8, opcode).put(64, content.length).raw(content.content);
  }
}

/** @param {Record<string, string>} entries */
function textMap(entries) {
  const content = new Bytes();
  for (const [key, value] of Object.entries(entries)) content.text(key).text(value);
  return new Bytes().put(32, content.length).raw(content.content);
}

/** Return a function that makes the messages of a topic from a stamp, ns, and numbers. */
/** @type {(topic: TopicFacts) => (stamp: bigint, values: number[]) => Uint8Array} */
function writer({ plain, stamps, numbers }) {
  const template = decoded(plain);
  return (stamp, values) => {
    const data = template.slice(), view = new DataView(data.buffer);
    const [seconds, rest] = [Number(stamp / SECOND), Number(stamp % SECOND)];
    for (const at of stamps) {
      view.setUint32(at, seconds, true);
      view.setUint32(at + 4, rest, true);
    }
    numbers.forEach((at, i) => view.setFloat64(at, values[i], true));
    return data;
  };
}

/** The messages of a session, in the order of its samples; those without numbers hold for all of them. */
/** @type {(session: Session, robot: Robot) => Generator<{channel: number, stamp: bigint, data: Uint8Array}>} */
function* messages(session, robot) {
  const at = session.at.bind(session), { topics } = session.facts, writers = topics.map(writer);
  /** @type {Record<string, (k: number) => number[]>} */
  const values = {
    "/joint_states": (k) => ["q", "v", "tau"].flatMap((group) => [...at(group, k)]),
    "/tf": (k) => robot.poses(k),
    "/end_effector": (k) => [...robot.end(k), ...at("quat", k)],
    "/target": (k) => {
      const position = robot.end(k);
      session.axes.forEach((axis, i) => (position[axis] = at("x_des", k)[i]));
      return [...position, ...at("quat_des", k)];
    },
  };
  for (let k = 0; k < session.count; k++) {
    const stamp = session.stamp(k);
    for (const [i, { name, numbers }] of topics.entries())
      if (numbers.length || k === 0) yield { channel: i + 1, stamp, data: writers[i](stamp, values[name]?.(k) ?? []) };
  }
}

/** @type {(session: Session, robot: Robot) => Uint8Array} The session as an MCAP file. */
export function mcap(session, robot) {
  const { topics, definitions, provenance } = session.facts, described = new Bytes(), types = Object.keys(definitions);
  types.forEach((type, i) =>
    described.record(OP.schema, new Bytes().put(16, i + 1).text(type).text("ros2msg").text(definitions[type])));
  topics.forEach(({ name, type, qos }, i) =>
    described.record(OP.channel, new Bytes().put(16, i + 1, types.indexOf(type) + 1).text(name).text("cdr")
      .raw(textMap({ offered_qos_profiles: qos, topic_type_hash: "" }).content)));
  const file = new Bytes().raw(MAGIC).record(OP.header, new Bytes().text("ros2").text("twodof")).raw(described.content);
  const indexes = new Bytes(), counts = topics.map(() => 0);
  let chunks = 0, chunk = new Chunk(topics.length);
  const flush = () => {
    if (!chunk.times.length) return;
    indexes.record(OP.chunkIndex, chunk.write(file));
    chunks += 1;
    chunk = new Chunk(topics.length);
  };
  for (const { channel, stamp, data } of messages(session, robot)) {
    counts[channel - 1] += 1;
    chunk.add(channel, stamp, data);
    if (chunk.records.length > CHUNK) flush();
  }
  flush();
  const at = file.length, origin = JSON.stringify({
    format: 1, ...provenance, start_time: 0, start_values: session.startValues,
    command_line: "a page in the browser", input_changes: session.changes,
  });
  file.record(OP.metadata, new Bytes().text("twodof").raw(textMap({ "run.json": origin }).content));
  const metadata = new Bytes().put(64, at, file.length - at).text("twodof");
  file.record(OP.dataEnd, new Bytes().put(32, 0));
  const summary = file.length, statistics = new Bytes();
  statistics.put(64, counts.reduce((sum, count) => sum + count)).put(16, types.length).put(32, topics.length, 0, 1, chunks);
  statistics.put(64, session.stamp(0), session.stamp(session.k)).put(32, 10 * topics.length);
  counts.forEach((count, i) => statistics.put(16, i + 1).put(64, count));
  file.raw(described.content).record(OP.statistics, statistics).raw(indexes.content);
  file.record(OP.metadataIndex, metadata);
  return file.record(OP.footer, new Bytes().put(64, summary, 0).put(32, 0)).raw(MAGIC).content;
}

/** A chunk of messages, with their offsets. */
class Chunk {
  records = new Bytes();
  /** @type {bigint[]} */
  times = [];

  /** @param {number} topics how many there are */
  constructor(topics) {
    /** @type {[bigint, number][][]} times and offsets of each topic's messages */
    this.messages = Array.from({ length: topics }, () => []);
  }

  /** @type {(channel: number, stamp: bigint, data: Uint8Array) => void} */
  add(channel, stamp, data) {
    this.messages[channel - 1].push([stamp, this.records.length]);
    this.times.push(stamp);
    this.records.record(OP.message, new Bytes().put(16, channel).put(32, 0).put(64, stamp, stamp).raw(data));
  }

  /** @type {(file: Bytes) => Bytes} Append the chunk and its indexes to a file; return the record of their offsets. */
  write(file) {
    const { records } = this, at = file.length, [start, end] = [this.times[0], this.times[this.times.length - 1]];
    const content = new Bytes().put(64, start, end, records.length).put(32, 0).text("").put(64, records.length);
    file.record(OP.chunk, content.raw(records.content));
    const size = file.length - at, offsets = new Bytes(), first = file.length;
    this.messages.forEach((entries, i) => {
      offsets.put(16, i + 1).put(64, file.length);
      const index = new Bytes().put(16, i + 1).put(32, 16 * entries.length);
      for (const [stamp, offset] of entries) index.put(64, stamp, offset);
      file.record(OP.messageIndex, index);
    });
    return new Bytes().put(64, start, end, at, size).put(32, offsets.length).raw(offsets.content)
      .put(64, file.length - first).text("").put(64, records.length, records.length);
  }
}
