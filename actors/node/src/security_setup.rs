//! The security setup of a starting node: its keys, its access list, and the log lines about unrestricted
//! access.

use std::{net::Ipv4Addr, path::PathBuf, sync::Arc};

use sinew_model::config::NodeConfig;
use sinew_runtime::{log, router::guard::ParameterRight};
use sinew_security::{
    access::{self, Access, AccessSummary, Applicant, List},
    node_security::NodeSecurity,
};

use super::builder::StartError;
use crate::NodeState;

/// Sets the credentials of the node in the state. Logs a warning if a node on a network has none.
pub(super) fn set_credentials(state: &NodeState, secured: Option<NodeSecurity>) {
    match secured {
        Some(secured) => drop(state.security.secured.set(secured)),
        None if !state.ctx.config.is_beyond_host() => {}
        None => log::warn!(
            interface = %state.ctx.config.ndl.interface,
            "this node is OPEN: any host on its network can send to its applications, and impersonate any node. Make keys with \
             `sinew keys init`, and set security.keys on all nodes"
        ),
    }
}

/// Logs a warning if a node has an address of a network but no configured interface, so that no other host
/// can reach it. A loopback address is taken as intended.
pub(super) fn warn_loopback_only(config: &NodeConfig) {
    let address = config.node_address();
    if config.ndl.interface.are_default() && !Ipv4Addr::from(address.bits()).is_loopback() {
        log::warn!(
            %address,
            interface = %config.ndl.interface,
            "this node is on loopback alone, the default, though its address is one of a network: no other host sees it, and it sees none. Set \
             ndl.interface to an address of this host there, or to \"lo\" if loopback is meant"
        );
    }
}

pub(super) fn read_access_list(config: &NodeConfig) -> Result<Option<(PathBuf, List)>, StartError> {
    let Some(path) = config.security.access.clone() else { return Ok(None) };
    match access::read(&path) {
        Ok(list) => Ok(Some((path, list))),
        Err(faults) => Err(StartError::Access { path, faults }),
    }
}

/// Puts the access list in force. Logs a warning if the node accepts unauthenticated identities from its network.
pub(super) fn set_access_list(state: &NodeState, list: Option<(PathBuf, List)>) {
    let Some((path, list)) = list else { return };
    let access = Access::new(state.ctx.node, path.clone(), list, state.ctx.refusals.clone());
    let AccessSummary { rules, clients } = access.summary();
    log::info!(?path, rules, clients, "an access list is in force: what no rule allows is refused");
    if state.security.secured.get().is_none() {
        // Loopback is no protection: a [[client]] rule that keeps a user out of the socket does not keep out
        // that user's own node.
        let who = if state.ctx.config.is_beyond_host() {
            "everybody on its network, and every user of this host,"
        } else {
            "every user of this host"
        };
        log::warn!(
            ?path,
            "the access list keeps out MISTAKES ONLY: without keys {who} can start another node that joins this one and \
             impersonates any node and application, also a user that a [[client]] refuses at the socket. Make keys with `sinew keys init`, and set \
             security.keys on all nodes"
        );
    }
    let own =
        Applicant { uid: rustix::process::geteuid().as_raw(), gid: rustix::process::getegid().as_raw() };
    if access.narrows(own) {
        log::warn!(
            ?path,
            "a [[client]] of the access list is about the node's own {own}: the robot's own processes have only the names and addresses that it \
             allows. If it is meant for other users, set their uid"
        );
    }
    warn_without_groups(&access);
    state.security.guard(&state.ctx.router, Arc::new(access));
}

/// Sets the senders that may set parameters where no access list names operators: the node's own applications and
/// clients, if the node is open and on loopback, else nobody. Without a list, only the node's own user and root can be
/// clients.
pub(super) fn set_parameter_right(state: &NodeState) {
    state.ctx.router.set_parameter_right(parameter_right(state));
}

/// Returns whether the node is open and on loopback: then its own user is an operator where no list names one.
pub(super) fn is_private(state: &NodeState) -> bool {
    state.security.secured.get().is_none() && !state.ctx.config.is_beyond_host()
}

fn parameter_right(state: &NodeState) -> ParameterRight {
    let has_list = state.security.access.get().is_some();
    match (has_list, is_private(state)) {
        (true, _) => ParameterRight::Any,
        (false, true) => ParameterRight::OfNode(state.ctx.node),
        (false, false) => ParameterRight::Nobody,
    }
}

/// Logs a warning for lists without `groups`, from older versions: a client that joined a group under such a
/// list cannot join it when it reconnects.
pub(super) fn warn_without_groups(access: &Access) {
    if let Some(lines) = access.without_groups(rustix::process::geteuid().as_raw()) {
        log::warn!(
            "[[client]] at {lines} names no groups: its clients can join none, unless another rule for them names some. Add `groups` where \
             they must join"
        );
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::Mutex, time::Duration};

    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::*;
    use sinew_security::testing::{self, Authority};

    #[test]
    fn node_open_beyond_host_warns() {
        let warning = |interface: Ipv4Addr, secured: Option<NodeSecurity>| {
            let mut config = NodeConfig::new("knee");
            config.ndl.interface = interface.into();
            let state = NodeState::for_test(config, Incarnation(1));
            logged(|| set_credentials(&state, secured))
        };
        let network = Ipv4Addr::new(192, 0, 2, 7);
        let words = warning(network, None);
        assert!(
            ["WARN", "this node is OPEN", "192.0.2.7", "sinew keys init", "security.keys"]
                .iter()
                .all(|word| words.contains(word)),
            "{words:?}"
        );
        assert_eq!(warning(Ipv4Addr::LOCALHOST, None), "");
        let credentials = Authority::new("walker").credentials("knee", 7);
        let own = NodeSecurity::new(testing::tls(&credentials), &credentials, 8, Incarnation(1));
        assert_eq!(warning(network, Some(own)), "");
    }

    #[test]
    fn network_address_on_default_loopback_warns() {
        let warning = |address: [u8; 4], interface: Option<Ipv4Addr>| {
            let mut config = NodeConfig::new("knee");
            config.address = Some(NodeAddress::from(address));
            if let Some(interface) = interface {
                config.ndl.interface = interface.into();
            }
            logged(|| warn_loopback_only(&config))
        };
        // Given: no configured interface
        let words = warning([192, 0, 2, 7], None);
        // Then: the log states cause and remedy
        assert!(
            ["WARN", "192.0.2.7", "127.0.0.1", "no other host sees it", "ndl.interface"]
                .iter()
                .all(|word| words.contains(word)),
            "{words:?}"
        );
        // And: nothing is logged if the node is reachable, loopback is configured, or its address is one of
        // loopback
        assert_eq!(warning([192, 0, 2, 7], Some(Ipv4Addr::new(192, 0, 2, 7))), "");
        assert_eq!(warning([192, 0, 2, 7], Some(Ipv4Addr::LOCALHOST)), "");
        assert_eq!(warning([127, 0, 0, 7], None), "");
    }

    #[test]
    fn access_list_without_keys_warns_once() {
        let warning = |interface: Ipv4Addr, is_secured: bool| {
            let mut config = NodeConfig::new("knee");
            config.ndl.interface = interface.into();
            let state = NodeState::for_test(config, Incarnation(1));
            if is_secured {
                let credentials = Authority::new("walker").credentials("knee", 7);
                let own = NodeSecurity::new(testing::tls(&credentials), &credentials, 8, Incarnation(1));
                assert!(state.security.secured.set(own).is_ok(), "it had none");
            }
            logged(|| set_access_list(&state, Some(("/there/access.toml".into(), List::default()))))
        };
        let network = Ipv4Addr::new(192, 0, 2, 7);
        for (interface, who) in [
            (Ipv4Addr::LOCALHOST, "without keys every user of this host"),
            (network, "everybody on its network"),
        ] {
            let words = warning(interface, false);
            assert_eq!(words.matches("MISTAKES ONLY").count(), 1, "{words:?}");
            assert!(words.contains(who) && words.contains("sinew keys init"), "{words:?}");
            assert!(!warning(interface, true).contains("MISTAKES"), "{interface}");
        }
    }

    #[test]
    fn parameters_need_open_loopback_node_or_list() {
        let state = |interface: Ipv4Addr| {
            let mut config = NodeConfig::new("knee");
            config.ndl.interface = interface.into();
            NodeState::for_test(config, Incarnation(1))
        };
        let (network, loopback) = (Ipv4Addr::new(192, 0, 2, 7), Ipv4Addr::LOCALHOST);
        let open = state(loopback);
        assert_eq!(parameter_right(&open), ParameterRight::OfNode(open.ctx.node));
        assert_eq!(parameter_right(&state(network)), ParameterRight::Nobody);
        let secured = state(loopback);
        let credentials = Authority::new("walker").credentials("knee", 7);
        let own = NodeSecurity::new(testing::tls(&credentials), &credentials, 8, Incarnation(1));
        assert!(secured.security.secured.set(own).is_ok(), "it had none");
        assert_eq!(parameter_right(&secured), ParameterRight::Nobody);
        let listed = state(network);
        listed.security.access_in_test(&listed.ctx, "");
        assert_eq!(parameter_right(&listed), ParameterRight::Any);
    }

    #[test]
    fn user_rule_without_groups_warns_once() {
        let state = NodeState::for_test(NodeConfig::new("knee"), Incarnation(1));
        let other = rustix::process::geteuid().as_raw() + 7;
        let access = state.security.access_in_test(&state.ctx, &format!("[[client]]\nuid = {other}\n"));
        let words = logged(|| warn_without_groups(&access));
        assert_eq!(
            words.matches("[[client]] at line 1 names no groups: its clients can join none").count(),
            1,
            "{words:?}"
        );
        access.replace_in_test(&format!("[[client]]\nuid = {other}\ngroups = ['telemetry']\n"));
        assert_eq!(logged(|| warn_without_groups(&access)), "");
    }

    /// Returns the log lines of this call.
    fn logged(call: impl FnOnce()) -> String {
        let written = Written::default();
        let to = written.clone();
        let reader = tracing_subscriber::fmt().with_writer(move || to.clone()).with_ansi(false).finish();
        tracing::subscriber::with_default(reader, call);
        log::flush(Duration::from_secs(20));
        String::from_utf8(written.0.lock().expect("nobody panics with it").clone()).expect("text")
    }

    /// The destination of a log.
    #[derive(Clone, Default)]
    struct Written(Arc<Mutex<Vec<u8>>>);

    impl std::io::Write for Written {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().expect("nobody panics with it").extend(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
}
