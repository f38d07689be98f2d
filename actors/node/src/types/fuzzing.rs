//! Checks arbitrary frames about types against the promised properties.

use std::collections::BTreeMap;

use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Header, Kind, Message, MismatchPolicy, SchemaHash, encode},
};
use sinew_schema::{Schema, Shape};

use super::{
    frames::{Frame, MismatchReport, SchemaAnswer, SchemaQuestion},
    judgement::{Judgement, sentence},
};

const KIND: Kind = Kind::named("demo.gains");

pub fn sent_frames() -> Vec<Vec<u8>> {
    let schema = Schema { root: Shape::F32, types: BTreeMap::new() };
    let (hash, schema) = (schema.hash(), schema.encode());
    let report = MismatchReport {
        source: AppAddress::new(0x1000),
        target: AppAddress::new(0x1001),
        kind: KIND,
        hash,
        policy: MismatchPolicy::Refuse.word().to_owned(),
        refused: true,
        seen: 1,
        schema: schema.clone(),
    };
    let question = encode(&SchemaQuestion { kind: KIND, hash: SchemaHash(1) });
    let answer = encode(&SchemaAnswer { kind: KIND, hash, schema });
    [question, answer, encode(&report)].map(|bytes| bytes.to_vec()).into()
}

pub fn frames(bytes: &[u8]) -> bool {
    let from = NodeAddress::new(2);
    let parse = |kind| {
        let message = Message::new(Header::new(kind, Tid::NONE, Tid::NONE), bytes.to_vec().into());
        Frame::parse(from, &message).ok()
    };
    let kinds = [Kind::SYNC_SCHEMA_ASK, Kind::SYNC_SCHEMA, Kind::SYNC_MISMATCH];
    let found: Vec<_> = kinds.into_iter().filter_map(parse).collect();
    for frame in &found {
        let (schema, policy) = match frame {
            Frame::Question(_) => continue,
            Frame::Answer(answer) => (&answer.schema, MismatchPolicy::default()),
            Frame::Report(report) => (&report.schema, report.policy()),
        };
        if let Ok(schema) = Schema::parse(schema) {
            let own = Schema { root: Shape::F32, types: BTreeMap::new() };
            let judgement = Judgement::of(&own, &schema, policy);
            assert!(!sentence(("gait", "knee"), "demo.gains", &judgement, 1).is_empty(), "it has words");
        }
    }
    !found.is_empty()
}
