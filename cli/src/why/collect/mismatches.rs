//! Collects the types that two applications have in different versions, from the nodes of both.

use std::collections::BTreeMap;

use sinew::{
    Tid,
    inspect::{AskMismatches, MismatchReport, MismatchesReport},
    message::Kind,
};

use super::{Collected, Found};

impl Collected<'_> {
    /// Returns the types that one of the two sends and the other handles in another version. A node of an older version
    /// does not know the question, and compares none.
    pub(super) fn mismatches(&mut self, found: &[Found; 2]) -> Vec<MismatchReport> {
        let [Some(one), Some(other)] = [found[0].app, found[1].app] else { return Vec::new() };
        let mut known: BTreeMap<(Tid, Tid, Kind), MismatchReport> = BTreeMap::new();
        for at in found.iter().filter_map(|found| found.at) {
            let asked = &self.nodes[at];
            if asked.result.is_err() {
                continue;
            }
            let (through, node, name) = (asked.through, asked.node, asked.name.clone());
            let answers =
                self.system(through).ask_these::<AskMismatches, MismatchesReport>(vec![(node, name)]);
            let reports = answers.into_iter().filter_map(|answer| answer.result.ok());
            for mismatch in reports.flat_map(|report| report.mismatches) {
                let (source, target) = (mismatch.source.tid, mismatch.target.tid);
                if (source, target) != (one, other) && (source, target) != (other, one) {
                    continue;
                }
                let key = (source, target, mismatch.kind);
                // The receiver's node judges, and the sender's node has its last report.
                if target.node == node {
                    known.insert(key, mismatch);
                } else {
                    known.entry(key).or_insert(mismatch);
                }
            }
        }
        known.into_values().collect()
    }
}
