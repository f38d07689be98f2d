//! What a node says of its access list, and has done with it.

use std::{sync::Arc, time::Duration};

use sinew_runtime::{
    outcome::Rejection,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Message},
};

use super::reports::{AccessReport, AccessVerdict, AskAccess, ReloadReport};
use crate::{
    access::{Access, Explanation, Question},
    lncl::Owner,
    node::NodeHandle,
    secured::DenyListError,
    stores::{Stores, lock},
};

/// How often tools may have files read again, and how often at once.
const READ_PERIOD: Duration = Duration::from_secs(1);
const ASKED_AT_ONCE: u32 = 4;
/// Longest account of what is wrong with a list, in characters.
const FAULTS_MAX: usize = 16 * 1024;

/// What the list says of messages between the two that the question names.
pub(super) fn explained(stores: &Arc<Stores>, question: &Message) -> Result<AccessReport, Rejection> {
    let AskAccess { source, target } = question.decode().map_err(|_| Rejection::Malformed)?;
    let Some(access) = stores.access.get() else {
        return Ok(AccessReport { is_given: false, verdicts: Vec::new() });
    };
    if target.node != stores.node || !target.is_single() || target.app.is_layer() {
        return Err(Rejection::NoSuchApplication);
    }
    Ok(AccessReport { is_given: true, verdicts: verdicts(access, (source, target), None) })
}

/// What the list says of messages from the one to the other, or to this group that the other is a member of; for each class.
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

/// Whether the application at `app` is one of this process, or of another one of the same user or of root.
fn is_of_the_nodes_user(stores: &Stores, app: AppAddress) -> bool {
    match lock(&stores.registry).owner_of(app) {
        Some(Owner::Node) => true,
        // Where there is no list there is nobody else here, and nothing to read.
        Some(Owner::Client { .. }) => {
            stores.access.get().is_none_or(|access| access.is_of(app, rustix::process::geteuid().as_raw()))
        }
        None => false,
    }
}

/// Whether the application at `watcher` is one of this node's that a guest has: a process of a user whom only the list lets in. Of those on
/// other nodes that is not known here.
pub(super) fn is_of_a_guest(stores: &Stores, watcher: Tid) -> bool {
    watcher.node == stores.node && stores.access.get().is_some() && !is_of_the_nodes_user(stores, watcher.app)
}

/// How often files were read again of late on the word of tools.
#[derive(Debug, Default)]
pub(super) struct Readings {
    /// When they may be read [`ASKED_AT_ONCE`] times again.
    full: Time,
}

impl Readings {
    /// Whether they may be read at `now`: so often at once, and once a second.
    fn admit(&mut self, now: Time) -> bool {
        let next = self.full.max(now) + READ_PERIOD;
        let may = next.since(now) <= READ_PERIOD * ASKED_AT_ONCE;
        if may {
            self.full = next;
        }
        may
    }
}

/// Has the lists read again, if somebody of the node's own user on this host wants it. spec: INSPECT-7
#[expect(clippy::unnecessary_wraps, reason = "all answers have one form")]
pub(super) fn reloaded(
    stores: &Arc<Stores>,
    readings: &mut Readings,
    question: &Message,
) -> Result<ReloadReport, Rejection> {
    if question.header.source.node != stores.node {
        let why =
            "lists are read again for a program of their node's own host only: run `sinew reload` there";
        return Ok(report(stores, why));
    }
    if !is_of_the_nodes_user(stores, question.header.source.app) {
        let why = "lists are read again for programs of their node's own user and of root only: run `sinew reload` as that user";
        return Ok(report(stores, why));
    }
    if !readings.admit(Time::now()) {
        return Ok(report(stores, "the lists were read a moment ago: ask again in a second"));
    }
    Ok(read_again(stores))
}

/// Has the lists read again, and says what is in force then.
fn read_again(stores: &Arc<Stores>) -> ReloadReport {
    let (node, mut faults) = (NodeHandle::of(stores.clone()), Vec::new());
    let mut readmitted = 0;
    let is_secured = stores.secured.get().is_some();
    // First: where there are many faults, those of the access list are cut.
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
    if stores.access.get().is_some() || !is_secured {
        faults.extend(node.reload_access().err().map(|why| why.to_string()));
    }
    ReloadReport { readmitted: readmitted as u64, ..report(stores, &faults.join("\n")) }
}

/// What is in force, and what is wrong, if anything is.
fn report(stores: &Stores, faults: &str) -> ReloadReport {
    let now = stores.access.get().map(|access| access.summary());
    ReloadReport {
        rules: now.map_or(0, |now| now.rules as u64),
        clients: now.map_or(0, |now| now.clients as u64),
        has_list: now.is_some(),
        denied: stores.secured.get().map(|secured| secured.tls.denied().len() as u64),
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
    use crate::{
        config::NodeConfig,
        lncl::{LocalApp, register_local},
        secured::Secured,
        security::{
            Identity, UnixTime, files,
            tests::ground::{self, Authority, Directory, Wish},
        },
    };

    const LIST: &str = "access.toml";
    const GOOD: &str = "[[rule]]\nfrom = ['hip']\nto = ['knee']\n";

    /// A node with an access list of one rule, and keys; both lists are in this directory.
    fn node() -> (Arc<Stores>, Directory) {
        let mut config = NodeConfig::new("knee");
        config.address = Some(NodeAddress::new(2));
        let stores = Stores::for_test(config, Incarnation(1));
        let identity =
            Identity { project: "sinew".to_owned(), address: stores.node, name: "knee".to_owned() };
        let directory = Authority::new("sinew").directory(&Wish::of(&identity));
        let credentials = ground::load(&directory, &identity);
        let secured = Secured::new(ground::tls(&credentials), &credentials, 8, Incarnation(1));
        assert!(stores.secured.set(secured).is_ok(), "it is set once");
        directory.put(LIST, 0o644, GOOD);
        let path = directory.path().join(LIST);
        let list = crate::access::read(&path).unwrap_or_else(|faults| panic!("{faults}"));
        let access = Access::new(stores.node, path, list, stores.refusals.clone());
        assert!(stores.access.set(Arc::new(access)).is_ok(), "it is set once");
        (stores, directory)
    }

    // spec: INSPECT-7
    #[test]
    fn a_long_list_of_other_faults_does_not_hide_that_the_deny_list_was_not_taken() {
        let (stores, directory) = node();
        directory.put(LIST, 0o644, &format!("{GOOD}classes = ['fast']\n").repeat(1_000));
        directory.put(files::DENIED, 0o644, "hip\n");
        let said = read_again(&stores).refused.expect("both have faults");
        assert!(said.chars().count() <= FAULTS_MAX, "{}", said.len());
        assert!(said.contains("deny list") && said.contains("access list"), "{said}");
    }

    // spec: INSPECT-7
    #[test]
    fn what_is_in_force_is_told_also_where_a_list_was_not_taken_or_there_is_more_to_do() {
        let (stores, directory) = node();
        directory.put(files::DENIED, 0o644, "2d6f\n2d70\n");
        let said = read_again(&stores);
        assert_eq!((said.rules, said.denied, said.refused), (1, Some(2), None));
        // One list is good, and the other one is not
        directory.put(LIST, 0o644, &GOOD.repeat(2));
        directory.put(files::DENIED, 0o644, "hip\n");
        let said = read_again(&stores);
        assert!(said.refused.is_some());
        assert_eq!((said.rules, said.denied), (2, Some(2)));
        // The node's own certificate is on it
        let is_revoked = || {
            let security = answers::security(&stores, UnixTime::now());
            security.certificate.is_some_and(|certificate| certificate.is_revoked)
        };
        assert!(!is_revoked());
        let own = stores.secured.get().expect("it has keys").serial.to_string();
        directory.put(files::DENIED, 0o644, &format!("{own}\n2d6f\n2d70\n"));
        let said = read_again(&stores);
        assert!(said.refused.is_some_and(|why| why.contains("own certificate")));
        assert!(is_revoked());
        assert_eq!((said.denied, said.readmitted), (Some(3), 0));
    }

    // spec: INSPECT-7
    #[test]
    fn how_many_certificates_went_off_the_deny_list_is_told() {
        let (stores, directory) = node();
        let own = stores.secured.get().expect("it has keys").serial.to_string();
        for (list, readmitted) in [
            ("2d6f\n2d70\n2d71\n".to_owned(), 0),
            // What half a copy may be.
            ("2d6f\n2d\n".to_owned(), 2),
            (own, 2),
            (String::new(), 1),
            (String::new(), 0),
        ] {
            directory.put(files::DENIED, 0o644, &list);
            assert_eq!(read_again(&stores).readmitted, readmitted, "{list:?}");
        }
    }

    #[test]
    fn lists_are_read_again_a_few_times_at_once_and_then_once_a_second() {
        let (mut readings, begin) = (Readings::default(), Time::from_nanos(1));
        let mut may = |at| (0..9).filter(|_| readings.admit(at)).count();
        assert_eq!(may(begin), 4);
        assert_eq!(may(begin + Duration::from_secs(1)), 1);
        assert_eq!(may(begin + Duration::from_secs(60)), 4);
    }

    // spec: INSPECT-6
    #[test]
    fn who_is_not_of_the_nodes_own_user_is_a_guest_where_there_is_a_list() {
        let (stores, _directory) = node();
        let (put, _inbox) = sync_channel(1);
        let own = LocalApp {
            name: None,
            address: None,
            requires: Vec::new(),
            kinds: Vec::new(),
            outlet: Arc::new(Inbox(put)),
            events: Arc::new([]),
        };
        let own = register_local(&stores, own).expect("nobody else is there");
        assert!(!is_of_a_guest(&stores, own));
        // Whoever has gone meanwhile is nobody's: it is not taken for the robot's own.
        let other = AppAddress::new(0x8000_1234);
        assert!(is_of_a_guest(&stores, Tid::new(stores.node, other)));
        assert!(!is_of_a_guest(&stores, Tid::new(NodeAddress::new(3), other)), "another node's");
        let open = Stores::for_test(NodeConfig::new("hip"), Incarnation(1));
        assert!(!is_of_a_guest(&open, Tid::new(open.node, other)), "no list, no guests");
    }
}
