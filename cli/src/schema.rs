//! `sinew schema`: the structures of a payload type on all nodes, and how they differ.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};
use sinew::{
    inspect::{AskSchemas, SchemasReport, TypeUser},
    message::Kind,
    schema::{Comparison, Schema, SchemaHash, compare},
};

use crate::{
    Report,
    system::{Answer, System, SystemError},
    table::{clean, clean_lines},
};

/// Asks every node for the structures of the type that it knows.
pub(crate) fn show(system: &mut System, name: &str) -> Result<Report, SystemError> {
    let here = system.here()?;
    let question = AskSchemas { kind: Kind::named(name) };
    let answers = system.ask_one_by_one::<AskSchemas, SchemasReport>(&here, &question);
    Ok(report(name, &Structures::of(answers)))
}

/// The structures of a type, put together from the answers of all nodes.
#[derive(Debug, Default)]
struct Structures {
    known: BTreeMap<SchemaHash, Structure>,
    /// The applications that handle the type with an unknown structure.
    unknown: BTreeSet<TypeUser>,
    left_out: u64,
    /// The nodes that did not answer, with the reason.
    silent: Vec<String>,
}

#[derive(Debug, Default)]
struct Structure {
    /// `None`: no answering node has it, or two nodes have different ones.
    schema: Option<Schema>,
    /// Whether two nodes gave different structures of this hash. One of both is constructed: nothing is compared.
    is_contested: bool,
    handled_by: BTreeSet<TypeUser>,
    sent_by: BTreeSet<TypeUser>,
}

/// The comparison of a structure that is sent with one that is handled.
struct Difference {
    sent: SchemaHash,
    handled: SchemaHash,
    comparison: Comparison,
}

impl Structures {
    fn of(answers: Vec<Answer<SchemasReport>>) -> Self {
        let mut all = Self::default();
        for Answer { node, name, result } in answers {
            match result {
                Ok(report) => all.add(report),
                Err(why) => all.silent.push(format!("{node} {}: {}", clean(&name), clean(&why))),
            }
        }
        let handlers = all.known.values().flat_map(|one| &one.handled_by);
        let handlers: BTreeSet<_> = handlers.map(|user| user.tid).collect();
        all.unknown.retain(|user| !handlers.contains(&user.tid));
        all
    }

    fn add(&mut self, report: SchemasReport) {
        for one in report.schemas {
            let known = self.known.entry(one.hash).or_default();
            let schema = one.schema.and_then(|bytes| Schema::parse(&bytes).ok());
            known.add(schema.filter(|schema| schema.hash() == one.hash));
            known.handled_by.extend(one.handled_by);
            known.sent_by.extend(one.sent_by);
        }
        self.unknown.extend(report.unknown);
        self.left_out = self.left_out.max(report.left_out);
    }

    /// Returns the differences between each structure that is sent and each other one that is handled.
    fn differences(&self) -> Vec<Difference> {
        let mut differences = Vec::new();
        for (sent, one) in self.known.iter().filter(|(_, one)| !one.sent_by.is_empty()) {
            for (handled, other) in self.known.iter().filter(|(_, other)| !other.handled_by.is_empty()) {
                if sent != handled
                    && let (Some(one), Some(other)) = (&one.schema, &other.schema)
                {
                    let comparison = compare(one, other);
                    differences.push(Difference { sent: *sent, handled: *handled, comparison });
                }
            }
        }
        differences
    }
}

impl Structure {
    /// Adds the structure that a node gave. A hash of 64 bits is no proof that it is the structure of another node.
    fn add(&mut self, given: Option<Schema>) {
        let Some(given) = given.filter(|_| !self.is_contested) else { return };
        self.is_contested = self.schema.as_ref().is_some_and(|former| *former != given);
        self.schema = (!self.is_contested).then_some(given);
    }

    /// Returns the structure for a person.
    fn words(&self) -> String {
        match &self.schema {
            Some(schema) => schema.to_string(),
            None if self.is_contested => "two nodes give different structures of this hash\n".to_owned(),
            None => "no node that answers has it\n".to_owned(),
        }
    }
}

fn report(name: &str, structures: &Structures) -> Report {
    let is_found = !structures.known.is_empty() || !structures.unknown.is_empty();
    let differences = structures.differences();
    let text = text(name, structures, &differences);
    Report { text, json: json(name, structures, &differences), is_fine: is_found }
}

fn text(name: &str, structures: &Structures, differences: &[Difference]) -> String {
    let name = clean(name);
    let mut text = match structures.known.len() {
        0 if structures.unknown.is_empty() => format!(
            "No application handles or has sent a type called `{name}`. `sinew apps --json` lists the types of each \
             application.\n"
        ),
        0 => format!("The structure of {name} is not known.\n"),
        1 => format!("{name} has one structure:\n"),
        count => format!("{name} has {count} structures:\n"),
    };
    for (hash, structure) in &structures.known {
        text += &format!("\n{hash}\n");
        text += &users("handled by", &structure.handled_by);
        text += &users("sent by", &structure.sent_by);
        text +=
            &structure.words().lines().map(|line| format!("    {}\n", clean_lines(line))).collect::<String>();
    }
    if !structures.unknown.is_empty() {
        text += &format!("\nwith an unknown structure\n{}", users("handled by", &structures.unknown));
    }
    for Difference { sent, handled, comparison } in differences {
        text += &format!("\nas {sent} sends it and {handled} handles it: {}\n", result(comparison));
        text += &comparison
            .differences()
            .iter()
            .map(|one| format!("    {}\n", clean(&one.to_string())))
            .collect::<String>();
    }
    if structures.left_out > 0 {
        text += &format!(
            "\n{} further structures and applications did not fit into an answer.\n",
            structures.left_out
        );
    }
    let silent: String = structures.silent.iter().map(|line| format!("{line}\n")).collect();
    if silent.is_empty() { text } else { format!("{text}\nNodes that did not answer:\n{silent}") }
}

fn users(what: &str, users: &BTreeSet<TypeUser>) -> String {
    let names: Vec<_> = users.iter().map(|user| format!("{} ({})", clean(&user.name), user.tid)).collect();
    if names.is_empty() { String::new() } else { format!("    {what} {}\n", names.join(", ")) }
}

/// Returns the result of a comparison in words.
const fn result(comparison: &Comparison) -> &'static str {
    match comparison {
        Comparison::Same => "no difference on the wire",
        Comparison::Addition(_) => "an addition, which is accepted by default",
        Comparison::Conflict(_) => "a conflict, which is refused by default",
    }
}

fn json(name: &str, structures: &Structures, differences: &[Difference]) -> Value {
    let users = |users: &BTreeSet<TypeUser>| -> Vec<Value> {
        users.iter().map(|user| json!({ "tid": user.tid.to_string(), "name": user.name })).collect()
    };
    let known = structures.known.iter().map(|(hash, one)| {
        json!({
            "hash": hash.to_string(), "schema": one.schema, "is_contested": one.is_contested,
            "handled_by": users(&one.handled_by), "sent_by": users(&one.sent_by),
        })
    });
    let differences = differences.iter().map(|Difference { sent, handled, comparison }| {
        let word = match comparison {
            Comparison::Same => "same",
            Comparison::Addition(_) => "addition",
            Comparison::Conflict(_) => "conflict",
        };
        let words: Vec<_> = comparison.differences().iter().map(ToString::to_string).collect();
        json!({ "sent": sent.to_string(), "handled": handled.to_string(), "result": word, "differences": words })
    });
    json!({
        "type": name, "kind": Kind::named(name).to_string(), "structures": known.collect::<Vec<_>>(),
        "unknown": users(&structures.unknown), "differences": differences.collect::<Vec<_>>(),
        "left_out": structures.left_out, "silent": structures.silent,
    })
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, NodeAddress, Payload, Tid, inspect::SchemaReport, payload, schema::schema_of};

    use super::*;

    payload!("test.schema.old" => struct Old { kp: f32 });
    payload!("test.schema.new" => struct New { kp: f32, kd: f32 });

    fn schema<P: Payload>() -> Schema {
        schema_of::<P>().expect("there is room").expect("it has a structure").schema().clone()
    }

    fn user(node: u32, name: &str) -> TypeUser {
        TypeUser { tid: Tid::new(NodeAddress::new(node), AppAddress::new(0x1000)), name: name.to_owned() }
    }

    fn answer(node: u32, result: Result<SchemasReport, String>) -> Answer<SchemasReport> {
        Answer { node: NodeAddress::new(node), name: "hip".to_owned(), result }
    }

    /// A node that knows the structure of one of both.
    fn of(has_old: bool) -> SchemasReport {
        let (old, new) = (schema::<Old>(), schema::<New>());
        let bytes = |schema: &Schema, has: bool| has.then(|| schema.encode());
        let report = |schema: &Schema, has, handled_by, sent_by| SchemaReport {
            hash: schema.hash(),
            schema: bytes(schema, has),
            handled_by,
            sent_by,
        };
        SchemasReport {
            name: None,
            schemas: vec![
                report(&old, has_old, Vec::new(), vec![user(1, "gait")]),
                report(&new, !has_old, vec![user(2, "knee")], Vec::new()),
            ],
            unknown: vec![user(2, "knee"), user(3, "plot")],
            left_out: 0,
        }
    }

    #[test]
    fn answers_of_all_nodes_give_structures_and_their_difference() {
        let silent = answer(3, Err("no answer".to_owned()));
        let answers = vec![answer(1, Ok(of(true))), answer(2, Ok(of(false))), silent];
        let report = report("demo.gains", &Structures::of(answers));
        let text = &report.text;
        assert!(report.is_fine && text.starts_with("demo.gains has 2 structures:\n"), "{text}");
        for part in [
            "    sent by gait (0.0.0.1/",
            "    handled by knee (0.0.0.2/",
            "        kp: f32,\n",
            "a conflict, which is refused by default\n    field `kd` is missing at the sender\n",
            "with an unknown structure\n    handled by plot (0.0.0.3/",
            "0.0.0.3 hip: no answer\n",
        ] {
            assert!(text.contains(part), "{part} in {text}");
        }
        assert_eq!(report.json["differences"][0]["result"], "conflict");
        assert_eq!(report.json["structures"].as_array().map(Vec::len), Some(2));
    }

    #[test]
    fn unknown_type_is_a_finding() {
        let report = report("demo.gans", &Structures::of(vec![answer(1, Ok(SchemasReport::default()))]));
        assert!(!report.is_fine && report.text.contains("`demo.gans`"), "{}", report.text);
    }

    #[test]
    fn false_structure_is_not_shown() {
        let mut forged = of(true);
        forged.schemas[0].schema = Some(schema::<New>().encode());
        let structures = Structures::of(vec![answer(1, Ok(forged))]);
        assert!(structures.known[&schema::<Old>().hash()].schema.is_none());
        assert!(structures.differences().is_empty());
    }

    #[test]
    fn two_structures_of_one_hash_are_not_compared() {
        let mut one = Structure::default();
        one.add(None);
        one.add(Some(schema::<Old>()));
        one.add(Some(schema::<Old>()));
        assert!(one.schema.is_some() && !one.is_contested);
        // Another structure stands for a constructed one: this type does not look at hashes.
        one.add(Some(schema::<New>()));
        one.add(Some(schema::<Old>()));
        assert!(one.schema.is_none() && one.is_contested);
        assert!(one.words().contains("two nodes give different structures"));
    }
}
