//! How closed a node is when it starts: its keys, its access list, and what its log says of whom neither keeps out.

use std::{net::Ipv4Addr, path::PathBuf, sync::Arc};

use super::builder::StartError;
use crate::{
    access::{self, Access, AccessSummary, Applicant, List},
    config::NodeConfig,
    log,
    secured::Secured,
    stores::Stores,
};

/// Gives the stores what the node proves itself with. One that has nothing, and is on a network, says so.
pub(super) fn secure(stores: &Stores, secured: Option<Secured>) {
    match secured {
        Some(secured) => drop(stores.secured.set(secured)),
        None if !stores.config.is_beyond_host() => {}
        None => log::warn!(
            interface = %stores.config.ndl.interface,
            "this node is OPEN: whoever is on its network can send to its applications, and pose as any node. Make keys with \
             `sinew keys init`, and set security.keys on all nodes"
        ),
    }
}

/// Says of a node with an address of a network that no other host hears it, as nobody has chosen an interface. Who writes loopback means it.
pub(super) fn say_deaf(config: &NodeConfig) {
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

pub(super) fn access_list(config: &NodeConfig) -> Result<Option<(PathBuf, List)>, StartError> {
    let Some(path) = config.security.access.clone() else { return Ok(None) };
    match access::read(&path) {
        Ok(list) => Ok(Some((path, list))),
        Err(faults) => Err(StartError::Access { path, faults }),
    }
}

/// Puts the access list in force. One that believes what anybody on the network says of himself is told of loudly.
pub(super) fn guard(stores: &Stores, list: Option<(PathBuf, List)>) {
    let Some((path, list)) = list else { return };
    let access = Access::new(stores.node, path.clone(), list, stores.refusals.clone());
    let AccessSummary { rules, clients } = access.summary();
    log::info!(?path, rules, clients, "an access list is in force: what no rule allows is refused");
    if stores.secured.get().is_none() {
        // Loopback is no door: a [[client]] that keeps a user out of the socket does not keep out his own node.
        let who = if stores.config.is_beyond_host() {
            "everybody on its network, and every user of this host,"
        } else {
            "every user of this host"
        };
        log::warn!(
            ?path,
            "the access list keeps out MISTAKES ONLY: without keys {who} can start a node of his own that joins this one, and pose with it as \
             any node and any application of it, also whom a [[client]] refuses at the socket. Make keys with `sinew keys init`, and set \
             security.keys on all nodes"
        );
    }
    let own =
        Applicant { uid: rustix::process::geteuid().as_raw(), gid: rustix::process::getegid().as_raw() };
    if access.narrows(own) {
        log::warn!(
            ?path,
            "a [[client]] of the access list is about the node's own {own}: the robot's own processes have only the names and addresses that it \
             lets them have. If it is meant for others, say their uid"
        );
    }
    say_without_groups(&access);
    stores.guard(Arc::new(access));
}

/// Lists from before there was `groups` name none: whoever was in a group by one of these is not, when it comes back.
pub(super) fn say_without_groups(access: &Access) {
    if let Some(lines) = access.without_groups(rustix::process::geteuid().as_raw()) {
        log::warn!(
            "[[client]] at {lines} names no groups: whom it lets in can join none, unless another one about it names some. Add `groups` where \
             they are to"
        );
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::Mutex, time::Duration};

    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::*;
    use crate::security::tests::ground::{self, Authority};

    #[test]
    fn a_node_that_is_open_beyond_its_host_says_so_loudly_and_one_that_is_not_says_nothing() {
        let said = |interface: Ipv4Addr, secured: Option<Secured>| {
            let mut config = NodeConfig::new("knee");
            config.ndl.interface = interface.into();
            let stores = Stores::for_test(config, Incarnation(1));
            logged(|| secure(&stores, secured))
        };
        let network = Ipv4Addr::new(192, 0, 2, 7);
        let words = said(network, None);
        assert!(
            ["WARN", "this node is OPEN", "192.0.2.7", "sinew keys init", "security.keys"]
                .iter()
                .all(|word| words.contains(word)),
            "{words:?}"
        );
        assert_eq!(said(Ipv4Addr::LOCALHOST, None), "");
        let credentials = Authority::new("walker").credentials("knee", 7);
        let own = Secured::new(ground::tls(&credentials), &credentials, 8, Incarnation(1));
        assert_eq!(said(network, Some(own)), "");
    }

    #[test]
    fn a_node_with_an_address_of_a_network_that_is_left_on_loopback_says_that_no_other_host_sees_it() {
        let said = |address: [u8; 4], interface: Option<Ipv4Addr>| {
            let mut config = NodeConfig::new("knee");
            config.address = Some(NodeAddress::from(address));
            if let Some(interface) = interface {
                config.ndl.interface = interface.into();
            }
            logged(|| say_deaf(&config))
        };
        // Given: nobody chose an interface
        let words = said([192, 0, 2, 7], None);
        // Then: cause and remedy are said
        assert!(
            ["WARN", "192.0.2.7", "127.0.0.1", "no other host sees it", "ndl.interface"]
                .iter()
                .all(|word| words.contains(word)),
            "{words:?}"
        );
        // And: nothing where it is heard, where loopback is meant, or where its address is one of loopback
        assert_eq!(said([192, 0, 2, 7], Some(Ipv4Addr::new(192, 0, 2, 7))), "");
        assert_eq!(said([192, 0, 2, 7], Some(Ipv4Addr::LOCALHOST)), "");
        assert_eq!(said([127, 0, 0, 7], None), "");
    }

    #[test]
    fn an_access_list_without_keys_says_once_whom_it_does_not_keep_out_and_with_keys_it_says_nothing_of_it() {
        let said = |interface: Ipv4Addr, is_secured: bool| {
            let mut config = NodeConfig::new("knee");
            config.ndl.interface = interface.into();
            let stores = Stores::for_test(config, Incarnation(1));
            if is_secured {
                let credentials = Authority::new("walker").credentials("knee", 7);
                let own = Secured::new(ground::tls(&credentials), &credentials, 8, Incarnation(1));
                assert!(stores.secured.set(own).is_ok(), "it had none");
            }
            logged(|| guard(&stores, Some(("/there/access.toml".into(), List::default()))))
        };
        let network = Ipv4Addr::new(192, 0, 2, 7);
        for (interface, who) in [
            (Ipv4Addr::LOCALHOST, "without keys every user of this host"),
            (network, "everybody on its network"),
        ] {
            let words = said(interface, false);
            assert_eq!(words.matches("MISTAKES ONLY").count(), 1, "{words:?}");
            assert!(words.contains(who) && words.contains("sinew keys init"), "{words:?}");
            assert!(!said(interface, true).contains("MISTAKES"), "{interface}");
        }
    }

    #[test]
    fn a_rule_for_users_that_names_no_groups_is_told_of_once() {
        let stores = Stores::for_test(NodeConfig::new("knee"), Incarnation(1));
        let other = rustix::process::geteuid().as_raw() + 7;
        let access = Access::in_test(&stores, &format!("[[client]]\nuid = {other}\n"));
        let words = logged(|| say_without_groups(&access));
        assert_eq!(
            words.matches("[[client]] at line 1 names no groups: whom it lets in can join none").count(),
            1,
            "{words:?}"
        );
        access.replace_in_test(&format!("[[client]]\nuid = {other}\ngroups = ['telemetry']\n"));
        assert_eq!(logged(|| say_without_groups(&access)), "");
    }

    /// What this says in the log.
    fn logged(say: impl FnOnce()) -> String {
        let written = Written::default();
        let to = written.clone();
        let reader = tracing_subscriber::fmt().with_writer(move || to.clone()).with_ansi(false).finish();
        tracing::subscriber::with_default(reader, say);
        log::flush(Duration::from_secs(20));
        String::from_utf8(written.0.lock().expect("nobody panics with it").clone()).expect("text")
    }

    /// Where a log is written to.
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
