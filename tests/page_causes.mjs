// The causes that the page names, of recordings as lines of JSON; argument: the URL of the page's scripts.
import { createInterface } from "node:readline";

const [{ Verdict }, { Robot }, { Samples }] = await Promise.all(
  ["verdict", "robot", "samples"].map((name) => import(`${process.argv[2]}/${name}.js`)));
for await (const line of createInterface({ input: process.stdin })) {
  const { facts, rows, changes, asked } = JSON.parse(line), samples = new Samples(facts, true), verdict = new Verdict(new Robot(samples));
  let causes = [];
  rows.forEach((row, k) => {
    samples.values = new Map([...samples.values, ...Object.entries(changes[k])]);
    samples.append(row);
    if (k % 25 === 0 || k === rows.length - 1) causes = verdict.causes();
  });
  const { balance } = verdict;
  console.log(JSON.stringify(asked ? balance[asked.call](...asked.arguments) : causes));
}
