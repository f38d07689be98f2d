//! The guarantees of a configuration: a complete one or all its faults, never a panic.

use std::net::SocketAddr;

use proptest::prelude::*;

use super::{
    check::{self, Range},
    file::KEYS,
    *,
};

const NAMED: &str = "[node]\nname = \"knee\"\n";

/// The complete file in the documentation.
fn example() -> &'static str {
    include_str!("../../../../docs/book/src/reference/node.toml")
}

fn faults(text: &str) -> Vec<ConfigFault> {
    NodeConfig::from_toml(text).map_or_else(ConfigError::into_vec, |config| panic!("legal: {config:?}"))
}

fn only_fault(text: &str) -> ConfigFault {
    let mut faults = faults(text);
    assert_eq!(faults.len(), 1, "{faults:?}");
    faults.remove(0)
}

/// A file with one setting, and perhaps more lines in that section.
fn with(key: &str, value: impl std::fmt::Display, more: &str) -> String {
    let (section, leaf) = key.split_once('.').unwrap();
    let name = if section == "node" && leaf != "name" { "name = 'knee'\n" } else { "" };
    let named = if section == "node" { "" } else { NAMED };
    format!("{named}[{section}]\n{name}{leaf} = {value}\n{more}")
}

#[test]
fn the_documented_file_is_the_defaults() {
    assert_eq!(NodeConfig::from_toml(example()).unwrap(), NodeConfig::new("knee"));
    assert_eq!(NodeConfig::from_toml(NAMED).unwrap(), NodeConfig::new("knee"));
}

#[test]
fn the_documented_file_names_every_key() {
    for key in KEYS {
        let leaf = key.split_once('.').unwrap().1;
        let named = |line: &str| line.trim_start_matches("# ").starts_with(&format!("{leaf} = "));
        assert!(example().lines().any(named), "{key}");
    }
}

#[test]
fn documented_faults_match_the_output() {
    let text =
        format!("{NAMED}\n[gncl]\n\nredial_max_ms = 5\n[ndl]\nperoid_ms = 100\nmissed_max = \"three\"\n");
    let shown = NodeConfig::from_toml(&text).unwrap_err().to_string();
    assert!(include_str!("../../../../docs/book/src/reference/configuration.md").contains(&shown), "{shown}");
}

#[test]
fn numbers_are_legal_up_to_both_ends() {
    let ranges = [
        (check::MAILBOX_CAPACITY, ""),
        (check::MAILBOX_BYTES, ""),
        (check::PAYLOAD_MAX, ""),
        (check::CLIENTS_MAX, ""),
        (check::CLIENTS_PER_PROCESS_MAX, ""),
        (check::LNCL_STRANGERS_MAX, ""),
        (check::STRANGERS_PER_PROCESS_MAX, ""),
        (check::CLIENTS_BYTES, ""),
        (check::APPS_MAX, ""),
        (check::RING_BYTES, ""),
        (check::GNCL_PORT, ""),
        (check::QUEUE_CAPACITY, ""),
        (check::QUEUE_BYTES, ""),
        (check::STRANGERS_MAX, ""),
        (check::HANDSHAKE, ""),
        (check::REDIAL_MIN, "redial_max_ms = 60_000"),
        (check::REDIAL_MAX, "redial_min_ms = 1"),
        (check::NDL_PORT, ""),
        (check::MDNS_PORT, ""),
        (check::PERIOD, ""),
        (check::MISSED_MAX, ""),
        (check::NODES_MAX, ""),
        (check::LAYER_DEADLINE, ""),
        (check::REQUIREMENT_DEADLINE, ""),
        (check::LAYER_RESTARTS_MAX, ""),
        (check::LAYER_WINDOW, ""),
        (check::APP_RESTARTS_MAX, ""),
        (check::APP_WINDOW, ""),
        (check::KEEP, "after_ms = 1_000"),
        (check::AFTER, "keep_ms = 600_000"),
        (check::FROZEN_MAX, ""),
    ];
    for (Range { key, low, high, .. }, more) in ranges {
        assert!(KEYS.contains(&key), "{key}");
        for legal in [low, high] {
            let read = NodeConfig::from_toml(&with(key, legal, more));
            assert!(read.is_ok(), "{key} = {legal}: {read:?}");
        }
        let below = i128::from(low) - 1;
        for illegal in [below.to_string(), (high + 1).to_string(), u128::MAX.to_string(), "'x'".to_owned()] {
            let fault = only_fault(&with(key, &illegal, more));
            assert_eq!(fault.key, key, "{illegal}");
            assert!(fault.legal.contains(&format!("{low} to {high}")), "{fault}");
            assert!(fault.line.is_some(), "{fault}");
        }
    }
}

#[test]
fn texts_are_legal_up_to_both_ends() {
    let name = |bytes| format!("{:?}", "n".repeat(bytes));
    let cases = [
        ("node.name", name(0), false),
        ("node.name", name(1), true),
        ("node.name", name(63), true),
        ("node.name", name(64), false),
        ("node.name", r#""a\nb""#.to_owned(), false),
        ("node.project", name(0), false),
        ("node.project", name(63), true),
        ("node.project", name(64), false),
        ("node.address", "'0.0.0.1'".to_owned(), true),
        ("node.address", "'255.255.255.254'".to_owned(), true),
        ("node.address", "'0.0.0.0'".to_owned(), false),
        ("node.address", "'*'".to_owned(), false),
        ("node.address", "'localhost'".to_owned(), false),
        ("lncl.socket", name(0), false),
        ("lncl.socket", name(1), true),
        ("lncl.socket", name(100), true),
        ("lncl.socket", name(101), false),
        ("lncl.socket", "false".to_owned(), true),
        ("lncl.socket", "true".to_owned(), false),
        ("gncl.announce", "'10.0.0.7:6912'".to_owned(), true),
        ("gncl.announce", "false".to_owned(), true),
        ("gncl.announce", "'10.0.0.7:0'".to_owned(), false),
        ("gncl.announce", "'0.0.0.0:6912'".to_owned(), false),
        ("gncl.announce", "'224.0.0.1:6912'".to_owned(), false),
        ("gncl.announce", "'10.0.0.7'".to_owned(), false),
        ("gncl.further", "[]".to_owned(), true),
        ("gncl.further", "['10.0.0.7', '10.1.0.7']".to_owned(), true),
        ("gncl.further", format!("{:?}", (1..8).map(|n| format!("10.0.0.{n}")).collect::<Vec<_>>()), true),
        ("gncl.further", format!("{:?}", (1..9).map(|n| format!("10.0.0.{n}")).collect::<Vec<_>>()), false),
        ("gncl.further", "['10.0.0.7', '10.0.0.7']".to_owned(), false),
        ("gncl.further", "['127.0.0.1']".to_owned(), false),
        ("gncl.further", "['0.0.0.0']".to_owned(), false),
        ("gncl.further", "['10.0.0.7:5']".to_owned(), false),
        ("gncl.further", "'10.0.0.7'".to_owned(), false),
        ("gncl.marks", "false".to_owned(), true),
        ("gncl.marks", "0".to_owned(), false),
        ("gncl.datagrams", "false".to_owned(), true),
        ("gncl.datagrams", "1".to_owned(), false),
        ("ndl.interface", "'127.0.0.1'".to_owned(), true),
        ("ndl.interface", "'0.0.0.0'".to_owned(), false),
        ("ndl.interface", "'224.0.0.1'".to_owned(), false),
        ("ndl.interface", "['10.0.0.7', '10.1.0.7']".to_owned(), true),
        ("ndl.interface", "['10.0.0.7', 'eth0', 'all']".to_owned(), true),
        ("ndl.interface", "['10.0.0.7', '10.0.0.7']".to_owned(), false),
        ("ndl.interface", "['10.0.0.7', 'eth0', 'eth0']".to_owned(), false),
        ("ndl.interface", "[]".to_owned(), false),
        ("ndl.interface", "['10.0.0.7', 7]".to_owned(), false),
        ("ndl.interface", "'10.0.0'".to_owned(), false),
        ("ndl.interface", format!("{:?}", (1..9).map(|n| format!("10.0.0.{n}")).collect::<Vec<_>>()), true),
        ("ndl.interface", format!("{:?}", (1..10).map(|n| format!("10.0.0.{n}")).collect::<Vec<_>>()), false),
        ("ndl.multicast", "'224.0.0.0:1'".to_owned(), true),
        ("ndl.multicast", "'239.255.255.255:65535'".to_owned(), true),
        ("ndl.multicast", "'223.255.255.255:1'".to_owned(), false),
        ("ndl.multicast", "'240.0.0.0:1'".to_owned(), false),
        ("ndl.multicast", "'239.0.0.1:0'".to_owned(), false),
        ("ndl.multicast", "false".to_owned(), true),
        ("ndl.multicast", "true".to_owned(), false),
        ("ndl.mdns_port", "false".to_owned(), true),
        ("ndl.mdns_port", "true".to_owned(), false),
        ("ndl.seeds", "[]".to_owned(), true),
        ("ndl.seeds", format!("{:?}", vec!["10.0.0.7:1"; 256]), true),
        ("ndl.seeds", format!("{:?}", vec!["10.0.0.7:1"; 257]), false),
        ("ndl.seeds", "['10.0.0.7:0']".to_owned(), false),
        ("ndl.seeds", "['10.0.0.7']".to_owned(), false),
        ("ndl.seeds", "[7]".to_owned(), false),
        ("ndl.seeds", "'10.0.0.7:1'".to_owned(), false),
    ];
    are_legal_or_not(cases);
}

#[test]
fn ipv6_texts_are_legal_up_to_both_ends() {
    let cases = [
        ("ndl.seeds", "['[fd00::7]:1', '[fe80::7]:1', '[fe80::7%eth0]:1']".to_owned(), true),
        ("ndl.seeds", "['[fe80::7%eth0]:0']".to_owned(), false),
        ("ndl.seeds", "['[::]:1']".to_owned(), false),
        ("ndl.seeds", "['[ff02::1]:1']".to_owned(), false),
        ("ndl.seeds", "['[::ffff:10.0.0.7]:1']".to_owned(), false),
        ("ndl.interface", "['10.0.0.7', 'fd00::7', 'fe80::7%eth0', 'eth0/ipv6']".to_owned(), true),
        ("ndl.interface", "['10.0.0.7', '::1']".to_owned(), true),
        ("ndl.interface", "['10.0.0.7', '::']".to_owned(), false),
        ("ndl.interface", "['10.0.0.7', 'ff02::1']".to_owned(), false),
        ("ndl.interface", "['10.0.0.7', '::ffff:10.0.0.7']".to_owned(), false),
        ("ndl.interface", "'eth0/ipv5'".to_owned(), false),
        ("ndl.multicast6", "'[ff02::5377]:1'".to_owned(), true),
        ("ndl.multicast6", "'[ff12::8000:1]:65535'".to_owned(), true),
        ("ndl.multicast6", "'[ff05::1]:1'".to_owned(), false),
        ("ndl.multicast6", "'[ff12::8000:1]:0'".to_owned(), false),
        ("ndl.multicast6", "'[fe80::1]:1'".to_owned(), false),
        ("ndl.multicast6", "'239.0.0.1:1'".to_owned(), false),
        ("ndl.multicast6", "false".to_owned(), true),
        ("ndl.multicast6", "true".to_owned(), false),
    ];
    are_legal_or_not(cases);
}

#[test]
fn groups_of_nodes_are_legal_up_to_both_ends() {
    let cases = [
        ("ndl.watch", watch("['leg.*', 'hip']", 10, 2), true),
        ("ndl.watch", format!("[{}]", [watch_one("['*']", 10, 2); 16].join(",")), true),
        ("ndl.watch", format!("[{}]", [watch_one("['*']", 10, 2); 17].join(",")), false),
        ("ndl.watch", watch("[]", 10, 2), false),
        ("ndl.watch", watch("['']", 10, 2), false),
        ("ndl.watch", watch("[7]", 10, 2), false),
        ("ndl.watch", watch("'hip'", 10, 2), false),
        ("ndl.watch", watch("['hip']", 9, 2), false),
        ("ndl.watch", watch("['hip']", 10, 1), false),
        ("ndl.watch", "[{nodes = ['hip'], period_ms = 10}]".to_owned(), false),
        ("ndl.watch", "[{nodes = ['hip'], period_ms = 10, missed_max = 2, speed = 1}]".to_owned(), false),
        ("ndl.watch", "{}".to_owned(), false),
    ];
    are_legal_or_not(cases);
}

#[test]
fn state_security_and_times_accept_only_valid_values() {
    let path = |bytes| format!("{:?}", "k".repeat(bytes));
    let cases = [
        ("security.keys", "false".to_owned(), true),
        ("security.keys", "true".to_owned(), false),
        ("security.keys", "7".to_owned(), false),
        ("security.keys", path(0), false),
        ("security.keys", path(1), true),
        ("security.keys", path(4_096), true),
        ("security.keys", path(4_097), false),
        ("security.keys", r#""a\u0000b""#.to_owned(), false),
        ("security.times", "'strict'".to_owned(), true),
        ("security.times", "'until-set'".to_owned(), true),
        ("security.times", "'ignored'".to_owned(), true),
        ("security.times", "'never'".to_owned(), false),
        ("security.times", "false".to_owned(), false),
        ("node.state", "false".to_owned(), true),
        ("node.state", "true".to_owned(), false),
        ("node.state", path(0), false),
        ("node.state", path(4_096), true),
        ("node.state", path(4_097), false),
        ("security.access", "false".to_owned(), true),
        ("security.access", "true".to_owned(), false),
        ("security.access", path(0), false),
        ("security.access", path(4_096), true),
        ("security.access", path(4_097), false),
        ("rt.probe_ms", "0".to_owned(), true),
        ("rt.probe_ms", "60000".to_owned(), true),
        ("rt.probe_ms", "60001".to_owned(), false),
        ("stop.on_lost", "true".to_owned(), true),
        ("stop.on_lost", "1".to_owned(), false),
        ("contracts.dry_run", "true".to_owned(), true),
        ("contracts.dry_run", "1".to_owned(), false),
        ("contracts.slack_ms", "0".to_owned(), true),
        ("contracts.slack_ms", "1000".to_owned(), true),
        ("contracts.slack_ms", "1001".to_owned(), false),
        ("log.level", "'off'".to_owned(), true),
        ("log.level", "'trace'".to_owned(), true),
        ("log.level", "'verbose'".to_owned(), false),
        ("log.level", "false".to_owned(), false),
    ];
    are_legal_or_not(cases);
    let config = NodeConfig::from_toml(&with("security.keys", "'/etc/keys'", "times = 'strict'")).unwrap();
    let security = SecurityConfig { keys: Some("/etc/keys".into()), times: TimePolicy::Strict, access: None };
    assert_eq!(config.security, security);
}

/// Keys, values, and whether they are legal.
fn are_legal_or_not<const N: usize>(cases: [(&str, String, bool); N]) {
    for (key, value, legal) in cases {
        let read = NodeConfig::from_toml(&with(key, &value, ""));
        match read {
            Ok(_) => assert!(legal, "{key} = {value}"),
            Err(faults) => {
                let one = matches!(faults.faults(), [fault] if fault.key == key && fault.line.is_some());
                assert!(!legal && one, "{key} = {value}: {faults}");
            }
        }
    }
}

/// A group of nodes as written in a file.
fn watch_one(nodes: &str, period_ms: u32, missed_max: u32) -> &'static str {
    format!("{{nodes = {nodes}, period_ms = {period_ms}, missed_max = {missed_max}}}").leak()
}

fn watch(nodes: &str, period_ms: u32, missed_max: u32) -> String {
    format!("[{}]", watch_one(nodes, period_ms, missed_max))
}

#[test]
fn first_matching_group_of_nodes_counts() {
    let text = format!(
        "{NAMED}[[ndl.watch]]\nnodes = ['leg.*']\nperiod_ms = 10\nmissed_max = 3\n\
         [[ndl.watch]]\nnodes = ['*.left', 'l*g.*t']\nperiod_ms = 100\nmissed_max = 5\n"
    );
    let config = NodeConfig::from_toml(&text).unwrap();
    let covering = |name: &str| config.ndl.watch.iter().position(|group| group.covers(name));
    assert_eq!(config.ndl.watch.iter().map(|group| group.missed_max).collect::<Vec<_>>(), [3, 5]);
    let expected =
        [("leg.left", Some(0)), ("arm.left", Some(1)), ("ling.t", Some(1)), ("lg.", None), ("left", None)];
    for (name, group) in expected {
        assert_eq!(covering(name), group, "{name}");
    }
}

#[test]
fn code_is_checked_like_a_file_but_finer() {
    let mut config = NodeConfig::new("");
    config.gncl.redial_min = Duration::from_micros(999);
    config.ndl.period = Duration::from_millis(60_000) + Duration::from_nanos(1);
    config.ndl.mdns_port = Some(0);
    config.ndl.seeds = vec![Seed::from(SocketAddr::from(([0, 0, 0, 0], 5)))];
    config.lncl.socket = Some("\0".into());
    let faults = config.validate().unwrap_err();
    let keys: Vec<&str> = faults.faults().iter().map(|fault| fault.key.as_str()).collect();
    let expected =
        ["node.name", "lncl.socket", "gncl.redial_min_ms", "ndl.mdns_port", "ndl.seeds", "ndl.period_ms"];
    assert_eq!(keys, expected);
    assert_eq!(faults.to_string().lines().count(), expected.len(), "one fault a line");
    assert_eq!(NodeConfig::new("knee").validate(), Ok(()));
}

#[test]
fn all_faults_of_a_file_are_reported_by_line() {
    let text =
        "[node]\nmailbox_capacity = 0\n[ndl]\nperiod_ms = -1\nmissed_max = 1.5\nspeed = 3\n[sink]\nx = 1\n";
    let found: Vec<_> = faults(text).into_iter().map(|fault| (fault.line, fault.key)).collect();
    let expected = [
        (None, "node.name"),
        (Some(2), "node.mailbox_capacity"),
        (Some(4), "ndl.period_ms"),
        (Some(5), "ndl.missed_max"),
        (Some(6), "ndl.speed"),
        (Some(7), "sink"),
    ];
    assert_eq!(found, expected.map(|(line, key)| (line, key.to_owned())));
}

#[test]
fn unknown_key_suggests_nearest_one() {
    for (text, nearest) in [
        ("[ndl]\nperiod = 1", "write ndl.period_ms,"),
        ("[gncl]\nredial_minimum_ms = 1", "write gncl.redial_min_ms,"),
        ("[sink]", "write [sync],"),
        ("ndl = 3", "write [ndl] on a line of its own"),
    ] {
        let found = only_fault(&format!("{text}\n{NAMED}"));
        assert!(found.remedy.starts_with(nearest), "{found}");
    }
    assert!(faults("name = 'knee'").iter().any(|fault| fault.remedy.starts_with("write node.name,")));
}

#[test]
fn misplaced_ipv6_address_names_the_right_setting() {
    for (line, key) in
        [("announce = '[fd00::7]:6912'", "gncl.announce"), ("further = ['fd00::7']", "gncl.further")]
    {
        let found = only_fault(&format!("[node]\nname = 'knee'\n[gncl]\n{line}\n"));
        assert_eq!((found.key.as_str(), found.line), (key, Some(4)));
        assert!(found.legal.contains("IPv4") && found.remedy.contains("ndl.interface"), "{found}");
    }
}

#[test]
fn invalid_toml_is_one_fault_with_its_line() {
    let found = only_fault("[node]\nname = \n");
    assert_eq!((found.key.as_str(), found.line), ("syntax", Some(2)));
}

#[test]
fn depth_without_end_is_one_fault() {
    assert_eq!(only_fault(&format!("x = {}", "[".repeat(100_000))).key, "syntax");
}

#[test]
fn unreadable_file_is_one_fault_with_its_path() {
    let faults = NodeConfig::from_file("/nowhere/knee.toml").unwrap_err();
    assert!(faults.to_string().starts_with("/nowhere/knee.toml: found No such file"), "{faults}");
}

proptest! {
    #[test]
    fn any_text_is_a_configuration_or_faults(text in any::<String>()) {
        let _ = NodeConfig::from_toml(&text);
    }

    #[test]
    fn any_values_are_a_configuration_or_faults(
        settings in proptest::collection::btree_map(prop::sample::select(&KEYS[..]), value(), 0..24),
    ) {
        let mut text = String::new();
        for section in ["node", "lncl", "gncl", "ndl", "sync"] {
            text += &format!("[{section}]\n");
            for (key, value) in settings.iter().filter(|(key, _)| key.starts_with(&format!("{section}."))) {
                text += &format!("{} = {value}\n", key.split_once('.').unwrap().1);
            }
        }
        match NodeConfig::from_toml(&text) {
            Ok(config) => prop_assert_eq!(config.validate(), Ok(())),
            Err(faults) => prop_assert!(faults.faults().iter().all(|fault| KEYS.contains(&fault.key.as_str()))),
        }
    }

    #[test]
    fn a_damaged_example_is_a_configuration_or_faults(at: prop::sample::Index, with in any::<char>()) {
        let mut text: Vec<char> = example().chars().collect();
        let at = at.index(text.len());
        text[at] = with;
        let _ = NodeConfig::from_toml(&text.iter().collect::<String>());
    }
}

fn value() -> impl Strategy<Value = String> {
    prop_oneof![
        any::<i64>().prop_map(|n| n.to_string()),
        (0u32..70_000).prop_map(|n| n.to_string()),
        any::<bool>().prop_map(|b| b.to_string()),
        any::<f64>()
            .prop_filter("TOML spells these differently", |f| f.is_finite())
            .prop_map(|f| format!("{f:?}")),
        "'[ -&(-~]{0,70}'",
        any::<[u8; 4]>().prop_map(|[a, b, c, d]| format!("'{a}.{b}.{c}.{d}'")),
        any::<([u8; 4], u16)>().prop_map(|([a, b, c, d], port)| format!("['{a}.{b}.{c}.{d}:{port}']")),
    ]
}

#[derive(Debug, PartialEq, serde::Deserialize)]
struct Drive {
    kp: f64,
    #[serde(default)]
    gains: Vec<Gain>,
}

#[derive(Debug, PartialEq, serde::Deserialize)]
struct Gain {
    at: u32,
}

fn with_apps(tables: &str) -> NodeConfig {
    NodeConfig::from_toml(&format!("[node]\nname = 'knee'\n{tables}")).unwrap()
}

#[test]
fn application_settings_accept_every_spelling_of_name() {
    let drive = Drive { kp: 2.5, gains: vec![Gain { at: 3 }] };
    let config = with_apps("[app.knee.drive]\nkp = 2.5\ngains = [{ at = 3 }]\n");
    assert_eq!(config.app::<Drive>("knee.drive").as_ref(), Ok(&drive));
    let config = with_apps("[app.'knee.drive']\nkp = 2.5\n[[app.'knee.drive'.gains]]\nat = 3\n");
    assert_eq!(config.app::<Drive>("knee.drive"), Ok(drive));
    assert_eq!(config.unclaimed_settings(), []);
}

#[test]
fn application_setting_fault_has_key_line_and_remedy() {
    let config = with_apps("[app.drive]\nkp = 'two'\nki = 1\n[app.driev]\nkp = 1\n");
    let faults = config.app::<Drive>("drive").unwrap_err();
    let places: Vec<_> = faults.faults().iter().map(|fault| (&*fault.key, fault.line)).collect();
    assert!(places.contains(&("app.drive.kp", Some(4))), "{faults}");
    let missing = config.app::<Drive>("drivee").unwrap_err().to_string();
    assert!(
        missing.contains("app.drivee: found no such table") && missing.contains("[app.drive]"),
        "{missing}"
    );
    let config = with_apps("[app.drive]\nkp = 2\nki = 1\n");
    let unknown = config.app::<Drive>("drive").unwrap_err().to_string();
    assert!(unknown.starts_with("app.drive.ki (line 5): found a key that does not exist"), "{unknown}");
}

#[test]
fn unused_settings_are_a_fault_with_nearest_name() {
    let config = with_apps("[app.knee.drive]\nkp = 1\n[app.knee.driev]\nkp = 1\n[app.camera]\nid = 1\n");
    config.app::<Drive>("knee.drive").unwrap();
    config.app_is_elsewhere("camera");
    let unread = config.unclaimed_settings();
    let [fault] = &*unread else { panic!("{unread:?}") };
    assert_eq!((&*fault.key, fault.line), ("app.knee.driev", Some(5)));
    assert!(fault.remedy.contains("[app.knee.drive]"), "{fault}");
}
