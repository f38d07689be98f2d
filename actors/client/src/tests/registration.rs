//! How an endpoint gets its address and its name, and the errors if it does not.

use std::{thread, time::Duration};

use sinew_runtime::wire::{Payload, PayloadType};

use super::{
    ApiError, AppAddress, AppFact, Doubled, Flags, Kind, NodeApi, RawClient, Registration, TestDirectory,
    TestNode, Tid, Torque, Transport, WATCHDOG,
    forms::{self, Api, Under},
    on, register,
};

on_every_transport! {
    addresses_are_fixed_or_dynamic_and_names_have_one_holder
    names_resolve_and_are_free_when_unregister_returns
    registration_waits_and_names_missing_requirements
    each_thread_may_have_its_own_address
}

fn refusal(under: Under, node: &TestNode, registration: Registration) -> String {
    match Api::connect(under, node).register(registration) {
        Err(ApiError::Refused(sentence)) => sentence,
        other => panic!("{other:?} instead of a refusal"),
    }
}

fn addresses_are_fixed_or_dynamic_and_names_have_one_holder(under: Under) {
    let node = TestNode::start();
    let fixed = AppAddress::fixed(7).unwrap();
    let first = register(under, &node, on(under).name("knee").fixed_address(fixed));
    assert!(first.transport().is_none_or(|transport| transport == under.transport));
    assert_eq!(first.tid(), Tid::new(node.address(), fixed));
    assert_eq!((first.node_name(), first.payload_max()), ("test", 1 << 20));
    let second = register(under, &node, on(under));
    assert!(second.tid().app.is_dynamic());
    let pid = std::process::id();
    let why = refusal(under, &node, on(under).name("knee"));
    assert!(why.contains(&format!("'knee' is taken by application {fixed} of process {pid}")), "{why}");
    let why = refusal(under, &node, on(under).fixed_address(fixed));
    assert!(why.contains("is taken by 'knee'"), "{why}");
    let why = refusal(under, &node, on(under).fixed_address(AppAddress::NDL));
    assert!(why.contains("fixed addresses are"), "{why}");
    // The next incarnation of its former holder gets it again.
    first.unregister().unwrap();
    assert_eq!(
        register(under, &node, on(under).name("knee").fixed_address(fixed)).tid(),
        Tid::new(node.address(), fixed)
    );
}

#[test]
fn missing_node_error_names_the_path() {
    let directory = TestDirectory::new();
    let error = NodeApi::connect(directory.path().join("nobody.sock")).unwrap_err();
    assert!(error.to_string().contains("nobody.sock"), "{error}");
}

fn names_resolve_and_are_free_when_unregister_returns(under: Under) {
    let node = TestNode::start();
    let mut endpoint = register(under, &node, on(under));
    assert_eq!(endpoint.resolve("hip", WATCHDOG).unwrap(), None);
    let hip = register(under, &node, on(under).name("hip"));
    assert_eq!(endpoint.resolve("hip", WATCHDOG).unwrap(), Some(hip.tid()));
    hip.unregister().unwrap();
    assert_eq!(endpoint.resolve("hip", WATCHDOG).unwrap(), None);
    register(under, &node, on(under).name("hip"));
}

fn registration_waits_and_names_missing_requirements(under: Under) {
    let mut node = TestNode::start();
    let api = Api::connect(under, &node);
    let wanted = on(under).requires(["knee.sensor", "central.gait"]);
    // Long enough for the node to report the missing requirements.
    let error = api.register(wanted.clone().deadline(Duration::from_secs(1))).unwrap_err();
    assert!(error.to_string().contains("knee.sensor, central.gait"), "{error}");
    let AppFact::Registered { app: given_up, .. } = node.fact() else { panic!("no registration") };
    assert_eq!(node.fact(), AppFact::Unregistered { app: given_up });
    let waiting = thread::spawn(move || api.register(wanted.deadline(WATCHDOG)));
    let AppFact::Registered { app, .. } = node.fact() else { panic!("no registration") };
    node.release(app);
    assert_eq!(waiting.join().unwrap().unwrap().tid().app, app);
}

fn each_thread_may_have_its_own_address(under: Under) {
    let node = TestNode::start();
    let api = Api::connect(under, &node);
    let app = node.local(1);
    thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                let mut endpoint = api.register(on(under)).unwrap();
                let kind = Kind::named("test.raw");
                for number in 0..100_u64 {
                    let mut buffer = endpoint.create_message(app.tid, kind, 8).unwrap();
                    buffer.copy_from_slice(&number.to_le_bytes());
                    endpoint.loaned(buffer).send().unwrap();
                }
            });
        }
        let mut next = std::collections::BTreeMap::<Tid, u64>::new();
        for _ in 0..800 {
            let message = app.next();
            let expected = next.entry(message.header.source).or_default();
            assert_eq!(message.payload[..], expected.to_le_bytes(), "in order for each source");
            *expected += 1;
            assert!(!message.header.flags.has(Flags::CONFIRM));
        }
        assert_eq!(next.len(), 8);
    });
}

/// A refused client receives the refusal behind its own request, and not only a broken pipe.
#[test]
fn early_refusal_reports_its_reason() {
    let node = TestNode::start_with(|config| config.lncl.strangers_per_process_max = 1);
    for _ in 0..20 {
        // A silent client keeps its place for two seconds, or for less if this thread is stopped.
        let _silent = RawClient::connect(&node);
        match NodeApi::connect(node.path()).unwrap().register_transport_address(Registration::new()) {
            Err(ApiError::Refused(why)) => assert!(why.contains("strangers_per_process_max"), "{why}"),
            Ok(_) => {}
            Err(other) => panic!("{other:?} instead of a refusal"),
        }
    }
    assert!(node.refused("too many strangers") > 0);
}

/// The first registration of a process traces the types beside it; later ones need not.
// spec: LNCL-21
#[test]
fn types_are_declared_at_each_registration() {
    for transport in [Transport::Ring, Transport::Socket] {
        let node = TestNode::start();
        let types = node.with_types();
        let api = NodeApi::connect(node.path()).unwrap();
        let registration = Registration::new().transport(transport).handles::<Torque>().sends::<Doubled>();
        assert_eq!(registration.register.kinds, [Torque::NAME, Doubled::NAME]);
        for _ in 0..2 {
            let endpoint = api.register_transport_address(registration.clone()).unwrap();
            let mut declared = [types.next(), types.next()];
            declared.sort_by_key(|(_, one)| one.sends);
            for ((app, one), of) in
                declared.iter().zip([PayloadType::of::<Torque>(), PayloadType::of::<Doubled>()])
            {
                let schema = of.expect("there is room").schema().unwrap().schema().encode();
                assert_eq!((*app, one.kind, &one.schema), (endpoint.tid().app, of.unwrap().kind(), &schema));
            }
            let uses = declared.map(|(_, one)| (one.handles, one.sends));
            assert_eq!(uses, [(true, false), (false, true)]);
            endpoint.unregister().unwrap();
        }
        assert_eq!(node.refused("declaration of a type"), 0);
    }
}
