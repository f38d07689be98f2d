//! The reports of other nodes: messages of this node's applications are of types that their receivers declared
//! differently. Pure: the caller passes the time.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::Kind,
};
use sinew_schema::Schema;

use super::{
    frames::MismatchReport,
    judgement::{Judgement, Treatment},
};

/// Maximum number of reports that are kept. The oldest one is removed for a further one.
const REPORTS_MAX: usize = 256;
/// Minimum time between two reports on one path. Other nodes send one a minute, and the way takes more or less time.
const LOG_AGAIN: Duration = Duration::from_secs(50);

/// Maximum number of reports on further paths that one node sends in [`WINDOW`].
const OF_NODE_MAX: u32 = 16;
const WINDOW: Duration = Duration::from_secs(60);

/// The last report on each path.
#[derive(Debug, Default)]
pub(crate) struct Reported {
    reports: BTreeMap<(AppAddress, Tid, Kind), Report>,
    /// The begin of the window of each node, and the number of its reports on further paths since.
    further: BTreeMap<NodeAddress, (Time, u32)>,
}

/// A report of another node.
#[derive(Clone, Debug)]
pub(crate) struct Report {
    /// The sender, an application of this node.
    pub(crate) source: AppAddress,
    /// The receiver.
    pub(crate) target: Tid,
    pub(crate) kind: Kind,
    pub(crate) judgement: Judgement,
    /// The number of messages so far.
    pub(crate) seen: u64,
    at: Time,
}

impl Reported {
    /// Records a report of the node `from` on messages of a type with the structure `own`. Returns it if it is to be
    /// logged now.
    ///
    /// # Errors
    /// Returns the fault if the report has no valid structure, or the node has reported too many paths.
    pub(super) fn add(
        &mut self,
        now: Time,
        from: NodeAddress,
        report: &MismatchReport,
        own: &Schema,
    ) -> Result<Option<&Report>, String> {
        let target = Tid::new(from, report.target);
        let path = (report.source, target, report.kind);
        if self.reports.get(&path).is_some_and(|former| now.since(former.at) < LOG_AGAIN) {
            return Ok(None);
        }
        if !self.reports.contains_key(&path) {
            self.admit(now, from)?;
        }
        let handled = Schema::parse(&report.schema)
            .map_err(|fault| format!("from {from}, of kind {}: {fault}", report.kind))?;
        if handled.hash() != report.hash {
            return Err(format!("from {from}, of kind {}: its structure has another hash", report.kind));
        }
        let mut judgement = Judgement::of(own, &handled, report.policy());
        if report.refused {
            // The receiver's node decides: it may have compared by other rules.
            judgement.treatment = Treatment::Refused;
        }
        if !self.reports.contains_key(&path) && self.reports.len() >= REPORTS_MAX {
            let oldest = self.reports.iter().min_by_key(|(_, report)| report.at).map(|(path, _)| *path);
            oldest.into_iter().for_each(|path| _ = self.reports.remove(&path));
        }
        let report = Report {
            source: report.source,
            target,
            kind: report.kind,
            judgement,
            seen: report.seen,
            at: now,
        };
        self.reports.insert(path, report);
        Ok(self.reports.get(&path))
    }

    /// Counts a report of `from` on a further path.
    fn admit(&mut self, now: Time, from: NodeAddress) -> Result<(), String> {
        self.further.retain(|_, (begin, _)| now.since(*begin) < WINDOW);
        let (_, count) = self.further.entry(from).or_insert((now, 0));
        if *count >= OF_NODE_MAX {
            return Err(format!("from {from}, a report on a further type behind {OF_NODE_MAX} in a minute"));
        }
        *count += 1;
        Ok(())
    }

    /// Returns all reports.
    pub(crate) fn reports(&self) -> Vec<Report> {
        self.reports.values().cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};
    use sinew_runtime::wire::SchemaHash;

    use super::*;

    const KNEE: NodeAddress = NodeAddress::new(2);

    #[derive(Serialize, Deserialize)]
    struct Gains {
        kp: f32,
    }

    #[derive(Serialize, Deserialize)]
    struct Renamed {
        gain: f32,
    }

    fn report(source: u32) -> MismatchReport {
        let schema = Schema::of::<Gains>().unwrap();
        MismatchReport {
            source: AppAddress::new(source),
            target: AppAddress::new(0x1001),
            kind: Kind::named("demo.gains"),
            hash: schema.hash(),
            policy: "accept-additions".to_owned(),
            refused: true,
            seen: 3,
            schema: schema.encode(),
        }
    }

    const fn at(seconds: u64) -> Time {
        Time::from_nanos(seconds * 1_000_000_000)
    }

    #[test]
    fn report_says_in_words_what_differs_once_a_minute() {
        let (own, mut reported) = (Schema::of::<Renamed>().unwrap(), Reported::default());
        let first = reported.add(at(100), KNEE, &report(0x1000), &own).unwrap().expect("it is the first one");
        assert_eq!((first.judgement.treatment, first.seen), (Treatment::Refused, 3));
        let words = ["field `gain` (f32) at the sender seems to be `kp` (f32) at the receiver"];
        assert_eq!(first.judgement.differences, words);
        assert!(reported.add(at(101), KNEE, &report(0x1000), &own).unwrap().is_none());
        assert!(reported.add(at(160), KNEE, &report(0x1000), &own).unwrap().is_some());
        let forged = MismatchReport { hash: SchemaHash(1), ..report(0x1002) };
        assert!(reported.add(at(160), KNEE, &forged, &own).is_err());
        assert_eq!(reported.reports().len(), 1);
    }

    #[test]
    fn oldest_report_makes_room() {
        let (own, mut reported) = (Schema::of::<Renamed>().unwrap(), Reported::default());
        for n in 0..REPORTS_MAX as u32 + 5 {
            reported
                .add(at(100 + 4 * u64::from(n)), KNEE, &report(0x1000 + n), &own)
                .unwrap()
                .expect("it is new");
        }
        let reports = reported.reports();
        assert_eq!((reports.len(), reports[0].source), (REPORTS_MAX, AppAddress::new(0x1005)));
    }

    #[test]
    fn further_paths_of_one_node_are_limited() {
        let (own, mut reported) = (Schema::of::<Renamed>().unwrap(), Reported::default());
        for n in 0..OF_NODE_MAX {
            assert!(reported.add(at(100), KNEE, &report(0x1000 + n), &own).is_ok());
        }
        assert!(reported.add(at(159), KNEE, &report(0x2000), &own).is_err());
        assert!(reported.add(at(159), NodeAddress::new(3), &report(0x2000), &own).is_ok());
        assert!(reported.add(at(159), KNEE, &report(0x1000), &own).is_ok(), "it is a known path");
        assert!(reported.add(at(160), KNEE, &report(0x2000), &own).is_ok());
    }
}
