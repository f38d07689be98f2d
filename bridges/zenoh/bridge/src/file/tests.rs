//! Good files, and each fault.

use proptest::prelude::*;
use sinew::message::Class;

use super::*;
use crate::{Get, Target, rules::Origin};

const LEAST: &str = "project = \"leg\"\nsocket = \"/run/sinew/leg.sock\"\n";
const IN: &str = "[[in]]\nto = \"knee\"\ntypes = [\"leg.move\"]\n";
const OUT: &str = "[[out]]\ngroup = \"telemetry\"\ntypes = [\"leg.angle\"]\n";

fn faults(text: &str) -> Vec<String> {
    Config::parse(&(LEAST.to_owned() + text)).expect_err("it has a fault")
}

fn rules(text: &str) -> Config {
    Config::parse(&(LEAST.to_owned() + text)).expect("a good file")
}

#[test]
fn least_file_lets_nothing_pass() {
    let config = rules("");
    assert_eq!((config.name.as_str(), config.requests, config.queue), ("zenoh", 4, 256));
    assert_eq!((config.zenoh.mode, config.zenoh.scouting), (Mode::Client, false));
    assert_eq!(config.zenoh.connect, ["tcp/127.0.0.1:7447"]);
    assert!(
        config.rules.inward().is_empty() && config.rules.outward().is_empty() && !config.rules.shows_any()
    );
    assert!(config.warnings.is_empty());
}

#[test]
fn rules_have_their_defaults() {
    let config = rules(&(IN.to_owned() + OUT));
    let route = &config.rules.inward()[0];
    assert_eq!(route.address.target, Target::Name("knee".to_owned()));
    assert_eq!((route.class, route.allows_put, route.get), (Class::Control, true, None));
    assert!(route.protection.is_none());
    let origin = Origin::Group("telemetry".to_owned());
    assert!(config.rules.outward_of(&origin, config.rules.outward()[0].kind).is_some());
    assert_eq!(Vec::from_iter(config.rules.groups()), ["telemetry"]);
}

#[test]
fn all_keys_are_read() {
    let config = rules(
        "name = \"gate\"\naddress = 0x2001\nrequests = 2\nqueue = 64\n\
         [zenoh]\nmode = \"peer\"\nconnect = []\nlisten = [\"tls/127.0.0.1:7448\"]\nlease_ms = 500\n\
         [zenoh.tls]\nlisten_certificate = \"a\"\nlisten_private_key = \"b\"\n\
         [liveness]\napps = [\"leg.*\"]\nnodes = true\n\
         [[in]]\ntid = \"10.0.0.3/1001\"\ntypes = [\"leg.torque\"]\nclass = \"stream\"\nencoding = \"json\"\n\
         expires_after_ms = 20\nage_max_ms = 50\nprotected = { period_ms = 5 }\n\
         [[in]]\nto = \"knee\"\ntypes = [\"leg.ask\"]\nput = false\nget = \"ask\"\nwithin_ms = 300\n\
         [[in]]\ngroup = \"legs\"\ntypes = [\"leg.mode\"]\nget = \"confirm\"\n\
         [[out]]\nname = \"operator\"\ntypes = [\"leg.question\"]\nreply = \"leg.answer\"\ntoken = false\n\
         [[out]]\nbroadcast = true\ntypes = [\"leg.news\"]\nencoding = \"raw\"\n",
    );
    assert_eq!(config.address, Some(AppAddress::new(0x2001)));
    let [torque, ask, mode] = config.rules.inward() else { panic!("three rules") };
    assert_eq!((torque.class, torque.age_max), (Class::Stream, Some(Duration::from_millis(50))));
    assert!(torque.protection.is_some());
    assert_eq!((ask.get, ask.allows_put, mode.get), (Some(Get::Ask), false, Some(Get::Confirm)));
    let programs: Vec<_> = config.rules.programs().collect();
    assert!(programs.len() == 1 && !programs[0].needs_token);
    assert_eq!(config.zenoh.certificates().count(), 2);
    assert!(config.rules.app_token(sinew::Tid::from_bits(7), "leg.knee").is_some());
}

#[test]
fn unknown_key_is_refused_by_its_name() {
    for (text, name) in [
        ("routers = []\n", "routers"),
        (&*(IN.to_owned() + "putt = true\n"), "putt"),
        (&*(OUT.to_owned() + "to = \"x\"\n"), "to"),
        ("[zenoh]\nlisten_to = []\n", "listen_to"),
        ("[liveness]\nnames = []\n", "names"),
    ] {
        let faults = faults(text);
        let fault = &faults[0];
        assert!(fault.contains(&format!("unknown field `{name}`")), "{fault}");
        assert!(fault.contains("expected"), "it lists the keys that there are: {fault}");
    }
}

#[test]
fn each_fault_is_reported_with_its_place() {
    let protected = "protected = { period_ms = 5 }\n";
    let cases = [
        ("[[in]]\ntypes = [\"a\"]\n".to_owned(), "[[in]] 1: it needs exactly one of"),
        (IN.to_owned() + "group = \"legs\"\n", "[[in]] 1: it needs exactly one of"),
        (IN.to_owned() + IN, "[[in]] 2: a rule before it has knee and leg.move"),
        (IN.to_owned() + "put = false\n", "[[in]] 1: it allows nothing"),
        (IN.to_owned() + protected + "get = \"confirm\"\n", "[[in]] 1: a protected command is put"),
        (
            IN.replace("to = \"knee\"", "group = \"legs\"") + protected,
            "[[in]] 1: a protected type is for one",
        ),
        (
            IN.replace("to = \"knee\"", "group = \"legs\"") + "get = \"ask\"\n",
            "[[in]] 1: one application is asked",
        ),
        (IN.replace("leg.move", "sinew.stop.press"), "[[in]] 1: type \"sinew.stop.press\" belongs"),
        (
            IN.replace("to = \"knee\"", "tid = \"10.0.0.3/stop\""),
            "[[in]] 1: tid \"10.0.0.3/stop\" is not one",
        ),
        (IN.replace("to = \"knee\"", "tid = \"knee\""), "[[in]] 1: tid: 'knee' is not a TID"),
        (IN.replace("\"leg.move\"", ""), "[[in]] 1: types: 1 to 64"),
        (IN.to_owned() + "class = \"stream\"\nget = \"confirm\"\n", "[[in]] 1: a stream is not confirmed"),
        (OUT.to_owned() + "reply = \"a\"\n", "[[out]] 1: requests reach a `name` alone"),
        (OUT.replace("group = \"telemetry\"", "name = \"zenoh.1\""), "[[out]]: `name` is the bridge's own"),
        (
            "[zenoh]\nconnect = [\"udp/127.0.0.1:7447\"]\n".to_owned(),
            "zenoh: \"udp/127.0.0.1:7447\" is no endpoint",
        ),
        ("[zenoh]\nlisten = [\"tcp/127.0.0.1:7447\"]\n".to_owned(), "zenoh.listen: a client does not listen"),
        (
            "[zenoh.tls]\nconnect_certificate = \"a\"\n".to_owned(),
            "zenoh.tls.connect_certificate: a certificate",
        ),
        ("requests = 0\n".to_owned(), "requests: 1 to 32"),
        ("address = 5\n".to_owned(), "address: 0x1000 to"),
        ("name = \"a|b\"\n".to_owned(), "name: '|' belongs to"),
    ];
    for (text, fault) in cases {
        let faults = faults(&text);
        assert!(faults.iter().any(|found| found.starts_with(fault)), "{fault}: {faults:?}");
    }
}

#[test]
fn open_endpoints_and_commands_without_age_have_warnings() {
    let open = rules("[zenoh]\nconnect = [\"tcp/192.0.2.7:7447\", \"tls/192.0.2.7:7447\"]\n");
    assert!(
        open.warnings.len() == 1 && open.warnings[0].starts_with("tcp/192.0.2.7:7447"),
        "{:?}",
        open.warnings
    );
    let old = rules(&(IN.to_owned() + "protected = { period_ms = 5 }\n"));
    assert!(old.warnings[0].contains("age_max_ms"), "{:?}", old.warnings);
}

proptest! {
    #[test]
    fn any_text_is_a_configuration_or_refused(text in ".{0,200}") {
        let _ = Config::parse(&text);
        let _ = Config::parse(&(LEAST.to_owned() + &text));
    }
}
