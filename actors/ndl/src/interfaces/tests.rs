//! The addresses selected by a choice.

use std::net::Ipv4Addr;

use super::*;

fn local(name: &str, address: [u8; 4], is_running: bool) -> Local {
    Local {
        name: name.to_owned(),
        address: Ipv4Addr::from(address).into(),
        is_running,
        flags: Ipv6Flags::default(),
    }
}

fn local6(name: &str, ip: &str, interface: u32) -> Local {
    let address = LocalAddress { ip: ip.parse().unwrap(), interface };
    Local { name: name.to_owned(), address, is_running: true, flags: Ipv6Flags::default() }
}

fn chosen(choices: &[&str]) -> Interfaces {
    choices.iter().map(|choice| choice.parse().unwrap()).collect::<Vec<Interface>>().into()
}

fn in_words(addresses: &[LocalAddress]) -> String {
    addresses.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ")
}

#[test]
fn choice_takes_loopback_only_if_named() {
    let all = [
        local("lo", [127, 0, 0, 1], true),
        local("eth0", [10, 0, 0, 1], true),
        local("eth0", [10, 0, 0, 9], true),
        local("eth1", [10, 1, 0, 1], false),
    ];
    let of = |choices: &[&str]| {
        let usable = Usable::of(&chosen(choices), &all);
        [usable.running, usable.there].map(|addresses| in_words(&addresses))
    };
    assert_eq!(of(&["all"]), ["10.0.0.1 10.0.0.9", "10.0.0.1 10.0.0.9 10.1.0.1"]);
    assert_eq!(of(&["eth1", "10.0.0.9", "all"]), ["10.0.0.9 10.0.0.1", "10.1.0.1 10.0.0.9 10.0.0.1"]);
    assert_eq!(of(&["lo", "eth7"]), ["127.0.0.1", "127.0.0.1"]);
    assert_eq!(of(&["all", "127.0.0.1"])[0], "10.0.0.1 10.0.0.9 127.0.0.1");
}

#[test]
fn all_verified_own_addresses_are_known_for_any_choice() {
    let asked = Ipv6Flags { is_tentative: true, ..Ipv6Flags::default() };
    let all = [
        local("lo", [127, 0, 0, 1], true),
        local("eth0", [10, 0, 0, 1], true),
        local("docker0", [172, 17, 0, 1], false),
        local6("eth0", "fe80::1", 2),
        Local { flags: asked, ..local6("eth0", "fd00::1", 2) },
    ];
    let Usable { own, names, .. } = Usable::of(&chosen(&["eth0/ipv4"]), &all);
    let words: Vec<_> = own.iter().map(ToString::to_string).collect();
    assert_eq!(words, ["127.0.0.1:0", "10.0.0.1:0", "172.17.0.1:0", "[fe80::1%2]:0"]);
    let names: Vec<_> = own.iter().map(|address| &*names[address]).collect();
    assert_eq!(names, ["lo", "eth0", "docker0", "eth0"]);
}

#[test]
fn loopback_by_name_takes_no_externally_reachable_address() {
    let name = if cfg!(target_os = "linux") { "lo" } else { "lo0" };
    let all = [
        local(name, [10, 9, 9, 9], true),
        local(name, [127, 0, 0, 1], true),
        local6(name, "fd00::9", 1),
        local6(name, "::1", 1),
    ];
    let of = |choices: &[&str]| in_words(&Usable::of(&chosen(choices), &all).running);
    assert_eq!(of(&[name]), "127.0.0.1 ::1");
    assert_eq!(of(&["10.9.9.9"]), "10.9.9.9", "an address must be chosen explicitly");
}

#[test]
fn name_takes_both_families_or_the_requested_one() {
    let mut all = vec![
        local("eth0", [10, 0, 0, 1], true),
        local6("lo", "::1", 1),
        local6("eth0", "2001:db8::1", 2),
        local6("eth0", "fd00::1", 2),
        local6("eth0", "fe80::1", 2),
        local6("eth1", "fe80::1", 3),
        local6("eth1", "fd01::1", 3),
    ];
    all[6].flags.is_temporary = true;
    let of = |choices: &[&str]| in_words(&Usable::of(&chosen(choices), &all).running);
    assert_eq!(of(&["eth0"]), "10.0.0.1 fe80::1%2 fd00::1", "the link's own, then the site's");
    assert_eq!(of(&["eth0/ipv4"]), "10.0.0.1");
    assert_eq!(of(&["all/ipv6"]), "fe80::1%2 fe80::1%3 fd00::1");
    assert_eq!(of(&["fe80::1"]), "fe80::1%2 fe80::1%3", "either interface has it");
    assert_eq!(of(&["fe80::1%eth1"]), "fe80::1%3");
    assert_eq!(of(&["fe80::1%3"]), "fe80::1%3");
    assert_eq!(
        of(&["fd01::1", "2001:db8::1"]),
        "fd01::1 2001:db8::1",
        "what is named is taken, whatever it is"
    );
    assert_eq!(of(&["all", "::1"]), "10.0.0.1 ::1 fe80::1%2 fe80::1%3 fd00::1", "the only one of its choice");
}

#[test]
fn tentative_address_is_unused_until_verified() {
    let mut all = [local6("eth0", "fe80::1", 2), local6("eth0", "fd00::1", 2)];
    all[0].flags.is_tentative = true;
    let usable = Usable::of(&chosen(&["eth0"]), &all);
    assert_eq!(
        (in_words(&usable.running), in_words(&usable.there)),
        ("fd00::1".to_owned(), "fd00::1".to_owned())
    );
    assert_eq!(usable.in_doubt, [(all[0].address, all[0].flags)]);
    all[0].flags.is_tentative = false;
    assert_eq!(in_words(&Usable::of(&chosen(&["eth0"]), &all).running), "fe80::1%2 fd00::1");
}

#[test]
fn each_named_interface_gets_a_first_path() {
    let names: Vec<_> = (1..=5).map(|number| format!("eth{number}")).collect();
    let all: Vec<_> = (1u8..=5)
        .zip(&names)
        .flat_map(|(number, name)| {
            let numbered = u32::from(number);
            [local(name, [10, number, 0, 1], true), local6(name, "fe80::1", numbered)]
        })
        .collect();
    let usable = Usable::of(&chosen(&names.iter().map(String::as_str).collect::<Vec<_>>()), &all);
    assert_eq!(
        in_words(&usable.running[..sinew_model::limits::PATHS_MAX]),
        "10.1.0.1 10.2.0.1 10.3.0.1 10.4.0.1 10.5.0.1 fe80::1%1 fe80::1%2 fe80::1%3"
    );
    let usable = Usable::of(&chosen(&["eth1/ipv6", "eth2", "fe80::1%eth3"]), &all);
    assert_eq!(
        in_words(&usable.running),
        "fe80::1%1 10.2.0.1 fe80::1%3 fe80::1%2",
        "what is preferred goes first"
    );
}

#[test]
fn tentative_address_takes_no_others_slot() {
    let mut all = [
        local6("eth0", "fe80::1", 2),
        local6("eth0", "fd00::9", 2),
        local6("eth0", "fd00::1", 2),
        local6("eth0", "2001:db8::1", 2),
    ];
    for doubt in [
        Ipv6Flags { is_duplicate: true, ..Ipv6Flags::default() },
        Ipv6Flags { is_tentative: true, ..Ipv6Flags::default() },
    ] {
        all[1].flags = doubt;
        let usable = Usable::of(&chosen(&["eth0"]), &all);
        assert_eq!(in_words(&usable.there), "fe80::1%2 fd00::1");
    }
}

#[test]
fn loopback_interface_is_seen_and_the_thread_ends() {
    let mut receiver = watch(chosen(&["lo"])).expect("a thread");
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    let localhost = LocalAddress::from(Ipv4Addr::LOCALHOST);
    let seen = runtime.block_on(async {
        let seen = receiver.wait_for(|usable| usable.running.contains(&localhost));
        tokio::time::timeout(Duration::from_secs(60), seen).await.expect("lo is seen within 60 s").is_ok()
    });
    assert!(seen);
}
