//! The stalled parts of a node. The node reports them in its answers, and the nodes that watch it read them.

use std::time::Duration;

use sinew_model::{config::NdlConfig, progress::Progress};
use sinew_runtime::time::Time;

/// Minimum time between two checks of a node by itself.
pub(crate) const CHECK_MIN: Duration = Duration::from_millis(100);
/// Returns the time between two checks of a node for its stalled parts.
pub fn check_period(config: &NdlConfig) -> Duration {
    config.period.max(CHECK_MIN)
}

/// Number of consecutive checks without an answer of the node's root after which that is reported.
const UNANSWERED: u32 = 3;
/// The root's last report of stalled parts, and whether the root still reports. The root itself may hang, and
/// its report is then outdated.
#[derive(Debug)]
pub(crate) struct RootWatch {
    report: Progress,
    reported_at: Time,
    /// Start time of the pending request, and the number of checks that found it unanswered.
    silent: Option<(Time, u32)>,
}

impl RootWatch {
    /// Creates a watch without a report and without a pending request.
    pub(crate) fn new(now: Time) -> Self {
        Self { report: Progress::default(), reported_at: now, silent: None }
    }

    /// Records an answer of the root.
    pub(crate) fn answered(&mut self, now: Time, report: Progress) {
        *self = Self { report, reported_at: now, silent: None };
    }

    /// Records that a report is requested from the root, or would be if its event queue were not full.
    pub(crate) fn requested(&mut self, now: Time) {
        self.silent.get_or_insert((now, 0));
    }

    /// Counts a check without an answer. Checks count and not time, because a node that is not scheduled
    /// makes no checks. Returns the report that the root does not answer, if it is due. // spec: NDL-9.2
    pub(crate) fn not_answered(&mut self, now: Time) -> Option<Progress> {
        let (since, times) = self.silent.as_mut()?;
        *times = times.saturating_add(1);
        let (silent, age) = (now.since(*since), now.since(self.reported_at));
        (*times >= UNANSWERED).then(|| self.report.clone().with_silent_root(silent, age))
    }
}

#[cfg(test)]
mod tests {
    use sinew_model::{
        facts::Trouble,
        progress::{IdleClient, Part, TroubleCode},
    };
    use sinew_runtime::tid::AppAddress;

    use super::*;

    fn part(app: u32) -> Part {
        let name = format!("app-{app:x}");
        Part { app: AppAddress::new(app), name, trouble: TroubleCode(Trouble::Stalled), since_ms: 300 }
    }

    fn client(app: u32) -> IdleClient {
        IdleClient { app: AppAddress::new(app), name: "ü".repeat(40), since_ms: 1_300 }
    }

    // spec: NDL-9.1
    #[test]
    fn clients_take_no_slot_from_the_nodes_own_parts() {
        let own = || Progress::of([0x9000_0000, 3, 4, 5].map(part).to_vec());
        let progress = own().with_clients((0x1000..0x9000).rev().map(client).collect());
        assert_eq!((progress.troubled, &progress.parts), (4, &own().parts));
        assert!(progress.is_fit() && progress.is_whole(), "so that resumed parts are reported");
        let named: Vec<_> = progress.clients.iter().map(|client| client.app.bits()).collect();
        assert_eq!((progress.idle, &named[..]), (0x8000, &[0x1000, 0x1001][..]));
        assert!(!Progress::default().with_clients(vec![client(1)]).is_nothing());
    }

    // spec: NDL-9.2
    #[test]
    fn root_without_three_answers_is_reported() {
        let at = |ms: u64| Time::from_nanos((1_000 + ms) * 1_000_000);
        let mut root = RootWatch::new(at(0));
        let report = Progress::of((5..9).map(part).collect()).with_clients(vec![client(1)]);
        root.requested(at(0));
        root.answered(at(1), report);
        // when: it hangs, or its event queue is full
        root.requested(at(100));
        assert_eq!(root.not_answered(at(200)), None);
        root.requested(at(200));
        assert_eq!(root.not_answered(at(300)), None);
        let told = root.not_answered(at(401)).unwrap();
        // then
        assert!(told.is_fit() && !told.is_whole());
        let named: Vec<_> = told.parts.iter().map(|part| (part.app.bits(), part.since_ms)).collect();
        assert_eq!((told.troubled, &named[..]), (5, &[(0, 301), (5, 700), (6, 700), (7, 700)][..]));
        assert_eq!(
            (told.parts[0].name.as_str(), told.parts[0].trouble),
            ("root", TroubleCode(Trouble::Stalled))
        );
        assert_eq!(told.clients[0].since_ms, 1_700);
        // and: after its next answer it has three attempts again
        root.answered(at(500), Progress::default());
        root.requested(at(600));
        assert_eq!((root.not_answered(at(700)), root.not_answered(at(800))), (None, None));
        // A root without a check for a long time has not been checked twice.
        root.answered(at(900), Progress::default());
        root.requested(at(1_000));
        assert_eq!(root.not_answered(at(99_000)), None);
    }

    #[test]
    fn too_many_clients_or_invalid_names_are_rejected() {
        let report = Progress::default().with_clients([1, 2].map(client).to_vec());
        assert!(report.is_fit());
        let named = |name: &str| vec![IdleClient { name: name.to_owned(), ..client(1) }];
        let unfit = [
            Progress { idle: 1, ..report.clone() },
            Progress {
                idle: 9,
                clients: [1, 2, 3].map(|app| IdleClient { name: String::new(), ..client(app) }).to_vec(),
                ..Progress::default()
            },
            Progress { clients: named(&"x".repeat(25)), ..report.clone() },
            Progress { clients: named("two\nlines"), ..report },
        ];
        unfit.iter().for_each(|report| assert!(!report.is_fit(), "{report:?}"));
    }
}
