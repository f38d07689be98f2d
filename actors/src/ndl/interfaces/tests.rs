//! Which addresses a choice takes.

use std::net::Ipv4Addr;

use super::*;

fn local(name: &str, address: [u8; 4], is_running: bool) -> Local {
    Local {
        name: name.to_owned(),
        address: Ipv4Addr::from(address).into(),
        is_running,
        flags: Flags::default(),
    }
}

fn local6(name: &str, ip: &str, interface: u32) -> Local {
    let address = LocalAddress { ip: ip.parse().unwrap(), interface };
    Local { name: name.to_owned(), address, is_running: true, flags: Flags::default() }
}

fn chosen(choices: &[&str]) -> Interfaces {
    choices.iter().map(|choice| choice.parse().unwrap()).collect::<Vec<Interface>>().into()
}

fn in_words(addresses: &[LocalAddress]) -> String {
    addresses.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ")
}

#[test]
fn a_choice_takes_what_it_names_in_order_and_once_and_loopback_only_where_it_is_asked_for() {
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
fn all_addresses_of_this_host_are_known_whichever_are_chosen_but_those_that_another_host_may_have() {
    let asked = Flags { is_tentative: true, ..Flags::default() };
    let all = [
        local("lo", [127, 0, 0, 1], true),
        local("eth0", [10, 0, 0, 1], true),
        local("docker0", [172, 17, 0, 1], false),
        local6("eth0", "fe80::1", 2),
        Local { flags: asked, ..local6("eth0", "fd00::1", 2) },
    ];
    let own = Usable::of(&chosen(&["eth0/ipv4"]), &all).own;
    let words: Vec<_> = own.iter().map(ToString::to_string).collect();
    assert_eq!(words, ["127.0.0.1:0", "10.0.0.1:0", "172.17.0.1:0", "[fe80::1%2]:0"]);
}

#[test]
fn of_loopback_by_its_name_nothing_is_taken_that_other_hosts_may_reach() {
    let name = if cfg!(target_os = "linux") { "lo" } else { "lo0" };
    let all = [
        local(name, [10, 9, 9, 9], true),
        local(name, [127, 0, 0, 1], true),
        local6(name, "fd00::9", 1),
        local6(name, "::1", 1),
    ];
    let of = |choices: &[&str]| in_words(&Usable::of(&chosen(choices), &all).running);
    assert_eq!(of(&[name]), "127.0.0.1 ::1");
    assert_eq!(of(&["10.9.9.9"]), "10.9.9.9", "who means it says it");
}

#[test]
fn a_name_takes_both_families_or_the_one_that_is_asked_for_and_of_ipv6_what_lasts() {
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
fn an_address_that_another_host_may_have_is_not_used_until_that_is_known() {
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
fn of_many_named_interfaces_each_has_a_path_before_any_has_one_of_ipv6_beside_it() {
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
        in_words(&usable.running[..crate::ndl::PATHS_MAX]),
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
fn an_address_that_another_host_may_have_takes_no_other_ones_place() {
    let mut all = [
        local6("eth0", "fe80::1", 2),
        local6("eth0", "fd00::9", 2),
        local6("eth0", "fd00::1", 2),
        local6("eth0", "2001:db8::1", 2),
    ];
    for doubt in
        [Flags { is_duplicate: true, ..Flags::default() }, Flags { is_tentative: true, ..Flags::default() }]
    {
        all[1].flags = doubt;
        let usable = Usable::of(&chosen(&["eth0"]), &all);
        assert_eq!(in_words(&usable.there), "fe80::1%2 fd00::1");
    }
}

#[test]
fn the_loopback_interface_is_seen_and_the_thread_ends_with_its_listener() {
    let mut told = watch(chosen(&["lo"])).expect("a thread");
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    let localhost = LocalAddress::from(Ipv4Addr::LOCALHOST);
    let seen = runtime.block_on(async {
        let seen = told.wait_for(|usable| usable.running.contains(&localhost));
        tokio::time::timeout(Duration::from_secs(60), seen).await.expect("lo is seen within 60 s").is_ok()
    });
    assert!(seen);
}
