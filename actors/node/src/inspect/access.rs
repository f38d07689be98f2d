//! Answers questions about the node's access list, and reloads the list on request.

use std::{sync::Arc, time::Duration};

use sinew_lncl::Owner;
use sinew_runtime::{
    lock,
    outcome::Rejection,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Message},
};
use sinew_security::{
    access::{Access, Explanation, Question},
    node_security::DenyListError,
};

use super::reports::{AccessReport, AccessVerdict, AskAccess, ReloadReport};
use crate::{NodeHandle, NodeState};

/// Minimum mean interval of reloads that tools may request, and the burst size.
const READ_PERIOD: Duration = Duration::from_secs(1);
const ASKED_AT_ONCE: u32 = 4;
/// Maximum characters of the description of a list's faults.
const FAULTS_MAX: usize = 16 * 1024;

/// Returns the list's verdicts on messages between the two applications of the question.
pub(super) fn explained(state: &Arc<NodeState>, question: &Message) -> Result<AccessReport, Rejection> {
    let AskAccess { source, target } = question.decode().map_err(|_| Rejection::Malformed)?;
    let Some(access) = state.security.access.get() else {
        return Ok(AccessReport { is_given: false, verdicts: Vec::new(), path: None });
    };
    if target.node != state.ctx.node || !target.is_single() || target.app.is_layer() {
        return Err(Rejection::NoSuchApplication);
    }
    let path = Some(access.path().display().to_string());
    Ok(AccessReport { is_given: true, verdicts: verdicts(access, (source, target), None), path })
}

/// Returns the list's verdicts, for each class, on messages from one application to another, or to this group of which
/// the other is a member.
pub(super) fn verdicts(
    access: &Access,
    (source, target): (Tid, Tid),
    group: Option<AppAddress>,
) -> Vec<AccessVerdict> {
    let verdict = |class| {
        let Explanation { is_allowed, why } = access.explain(Question { source, target, group, class });
        AccessVerdict { class, is_allowed, why }
    };
    Class::ALL.map(verdict).to_vec()
}

/// Returns whether the application at `app` belongs to this process, or to another process of the same user or of root.
pub(super) fn is_of_the_nodes_user(state: &NodeState, app: AppAddress) -> bool {
    match lock(&state.lncl.registry).owner_of(app) {
        Some(Owner::Node | Owner::Command) => true,
        // Without a list there are no clients of other users, and nothing to reload.
        Some(Owner::Client { .. }) => state
            .security
            .access
            .get()
            .is_none_or(|access| access.is_of(app, rustix::process::geteuid().as_raw())),
        None => false,
    }
}

/// Returns whether the application at `watcher` is a guest of this node: a process of a user that only the list admits.
/// For applications on other nodes this is not known here.
pub(super) fn is_of_a_guest(state: &NodeState, watcher: Tid) -> bool {
    watcher.node == state.ctx.node
        && state.security.access.get().is_some()
        && !is_of_the_nodes_user(state, watcher.app)
}

/// The recent reloads that tools requested.
#[derive(Debug, Default)]
pub(super) struct Readings {
    /// When [`ASKED_AT_ONCE`] reloads are available again.
    full: Time,
}

impl Readings {
    /// Returns whether a reload is allowed at `now`: a burst, then one per second.
    fn admit(&mut self, now: Time) -> bool {
        let next = self.full.max(now) + READ_PERIOD;
        let may = next.since(now) <= READ_PERIOD * ASKED_AT_ONCE;
        if may {
            self.full = next;
        }
        may
    }
}

/// Reloads the lists, if a process of the node's own user on this host requests it. spec: INSPECT-7
#[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
pub(super) fn reloaded(
    state: &Arc<NodeState>,
    readings: &mut Readings,
    question: &Message,
) -> Result<ReloadReport, Rejection> {
    if question.header.source.node != state.ctx.node {
        let why =
            "lists are read again for a program of their node's own host only: run `sinew reload` there";
        return Ok(report(state, why));
    }
    if !is_of_the_nodes_user(state, question.header.source.app) {
        let why = "lists are read again for programs of their node's own user and of root only: run `sinew reload` as that user";
        return Ok(report(state, why));
    }
    if !readings.admit(Time::now()) {
        return Ok(report(state, "the lists were read a moment ago: ask again in a second"));
    }
    Ok(read_again(state))
}

/// Reloads the lists, and reports the lists that are in force afterwards.
fn read_again(state: &Arc<NodeState>) -> ReloadReport {
    let (node, mut faults) = (NodeHandle::of(state.clone()), Vec::new());
    let mut readmitted = 0;
    let is_secured = state.security.secured.get().is_some();
    // First: if there are many faults, those of the access list are cut off.
    if is_secured {
        let read = node.reload_deny_list();
        readmitted = match &read {
            Ok(summary) | Err(DenyListError::Own { summary, .. } | DenyListError::NotTold { summary }) => {
                summary.readmitted
            }
            Err(DenyListError::Faults(_) | DenyListError::None) => 0,
        };
        faults.extend(read.err().map(|why| why.to_string()));
    }
    if state.security.access.get().is_some() || !is_secured {
        faults.extend(node.reload_access().err().map(|why| why.to_string()));
    }
    ReloadReport { readmitted: readmitted as u64, ..report(state, &faults.join("\n")) }
}

/// Reports the lists in force, and the faults, if there are any.
fn report(state: &NodeState, faults: &str) -> ReloadReport {
    let now = state.security.access.get().map(|access| access.summary());
    ReloadReport {
        rules: now.map_or(0, |now| now.rules as u64),
        clients: now.map_or(0, |now| now.clients as u64),
        has_list: now.is_some(),
        denied: state.security.secured.get().map(|secured| secured.tls.denied().len() as u64),
        readmitted: 0,
        refused: (!faults.is_empty()).then(|| faults.chars().take(FAULTS_MAX).collect()),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::sync_channel;

    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::{
        super::{answers, inspector::Inbox},
        *,
    };
    use sinew_lncl::{LocalApp, register_local};
    use sinew_model::config::NodeConfig;
    use sinew_security::{
        Identity, UnixTime, files,
        node_security::NodeSecurity,
        testing::{self, Authority, CertificateContent, Directory},
    };

    const LIST: &str = "access.toml";
    const GOOD: &str = "[[rule]]\nfrom = ['hip']\nto = ['knee']\n";

    /// A node with an access list of one rule, and keys; both lists are in this directory.
    fn node() -> (Arc<NodeState>, Directory) {
        let mut config = NodeConfig::new("knee");
        config.address = Some(NodeAddress::new(2));
        let state = NodeState::for_test(config, Incarnation(1));
        let identity =
            Identity { project: "sinew".to_owned(), address: state.ctx.node, name: "knee".to_owned() };
        let directory = Authority::new("sinew").directory(&CertificateContent::of(&identity));
        let credentials = testing::load(&directory, &identity);
        let secured = NodeSecurity::new(testing::tls(&credentials), &credentials, 8, Incarnation(1));
        assert!(state.security.secured.set(secured).is_ok(), "it is set once");
        directory.put(LIST, 0o644, GOOD);
        let path = directory.path().join(LIST);
        let list = sinew_security::access::read(&path).unwrap_or_else(|faults| panic!("{faults}"));
        let access = Access::new(state.ctx.node, path, list, state.ctx.refusals.clone());
        assert!(state.security.access.set(Arc::new(access)).is_ok(), "it is set once");
        (state, directory)
    }

    // spec: INSPECT-7
    #[test]
    fn long_fault_list_keeps_the_deny_list_fault() {
        let (state, directory) = node();
        directory.put(LIST, 0o644, &format!("{GOOD}classes = ['fast']\n").repeat(1_000));
        directory.put(files::DENIED, 0o644, "hip\n");
        let reloaded = read_again(&state).refused.expect("both have faults");
        assert!(reloaded.chars().count() <= FAULTS_MAX, "{}", reloaded.len());
        assert!(reloaded.contains("deny list") && reloaded.contains("access list"), "{reloaded}");
    }

    // spec: INSPECT-7
    #[test]
    fn active_lists_are_reported_despite_faults() {
        let (state, directory) = node();
        directory.put(files::DENIED, 0o644, "2d6f\n2d70\n");
        let reloaded = read_again(&state);
        assert_eq!((reloaded.rules, reloaded.denied, reloaded.refused), (1, Some(2), None));
        // One list is valid, and the other is not
        directory.put(LIST, 0o644, &GOOD.repeat(2));
        directory.put(files::DENIED, 0o644, "hip\n");
        let reloaded = read_again(&state);
        assert!(reloaded.refused.is_some());
        assert_eq!((reloaded.rules, reloaded.denied), (2, Some(2)));
        // The list contains the node's own certificate
        let is_revoked = || {
            let security = answers::security(&state, UnixTime::now());
            security.certificate.is_some_and(|certificate| certificate.is_revoked)
        };
        assert!(!is_revoked());
        let own = state.security.secured.get().expect("it has keys").serial.to_string();
        directory.put(files::DENIED, 0o644, &format!("{own}\n2d6f\n2d70\n"));
        let reloaded = read_again(&state);
        assert!(reloaded.refused.is_some_and(|why| why.contains("own certificate")));
        assert!(is_revoked());
        assert_eq!((reloaded.denied, reloaded.readmitted), (Some(3), 0));
    }

    // spec: INSPECT-7
    #[test]
    fn number_of_reinstated_certificates_is_reported() {
        let (state, directory) = node();
        let own = state.security.secured.get().expect("it has keys").serial.to_string();
        for (list, readmitted) in [
            ("2d6f\n2d70\n2d71\n".to_owned(), 0),
            // Possible contents of a partial copy.
            ("2d6f\n2d\n".to_owned(), 2),
            (own, 2),
            (String::new(), 1),
            (String::new(), 0),
        ] {
            directory.put(files::DENIED, 0o644, &list);
            assert_eq!(read_again(&state).readmitted, readmitted, "{list:?}");
        }
    }

    #[test]
    fn reloads_are_rate_limited_after_a_burst() {
        let (mut readings, begin) = (Readings::default(), Time::from_nanos(1));
        let mut may = |at| (0..9).filter(|_| readings.admit(at)).count();
        assert_eq!(may(begin), 4);
        assert_eq!(may(begin + Duration::from_secs(1)), 1);
        assert_eq!(may(begin + Duration::from_secs(60)), 4);
    }

    // spec: INSPECT-6
    #[test]
    fn unknown_application_is_a_guest_if_a_list_exists() {
        let (state, _directory) = node();
        let (put, _inbox) = sync_channel(1);
        let own = LocalApp {
            name: None,
            address: None,
            requires: Vec::new(),
            kinds: Vec::new(),
            sink: Arc::new(Inbox(put)),
            events: Arc::new([]),
        };
        let own = register_local(&state.lncl, own).expect("nobody else is there");
        assert!(!is_of_a_guest(&state, own));
        // An application that has gone in the meantime does not count as the robot's own.
        let other = AppAddress::new(0x8000_1234);
        assert!(is_of_a_guest(&state, Tid::new(state.ctx.node, other)));
        assert!(!is_of_a_guest(&state, Tid::new(NodeAddress::new(3), other)), "another node's");
        let open = NodeState::for_test(NodeConfig::new("hip"), Incarnation(1));
        assert!(!is_of_a_guest(&open, Tid::new(open.ctx.node, other)), "no list, no guests");
    }
}
