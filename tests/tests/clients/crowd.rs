//! A process that uses all registrations of its share leaves the other processes theirs.

use sinew::{NodeApi, Registration};
use sinew_testkit::NodeProcess;

use sinew_tests::clients::{FixtureLimits, NodeFixture};

/// One process may have a quarter of these.
const CLIENTS: usize = 12;

/// Starts a process that takes all that it can have. Returns it and its first two lines.
fn crowd(fixture: &NodeFixture) -> (NodeProcess, [String; 2]) {
    let mut process = fixture.start("crowd", &[]);
    let lines = [process.wait_for(&[]), process.wait_for(&[])];
    process.expect("silent");
    (process, lines)
}

#[test]
fn process_at_its_limit_locks_out_no_other() {
    // Given: a node, and a process that registers until it is rejected and also has silent connections.
    let limits = FixtureLimits { mailbox_capacity: 16, payload_max: 4_096, clients_max: CLIENTS };
    let fixture = NodeFixture::new(limits);
    let (first, [has, refused]) = crowd(&fixture);
    assert_eq!(has, format!("has {}", CLIENTS / 4));
    assert!(
        refused.starts_with("refused") && refused.contains("`lncl.clients_per_process_max`"),
        "{refused}"
    );

    // When: another process registers while the silent connections are within their time limit.
    let api = NodeApi::connect(fixture.socket()).expect("the door is open");
    let endpoint = api.register_transport_address(Registration::new());

    // Then: it is registered, and so is a second crowd.
    assert!(endpoint.is_ok(), "{endpoint:?}");
    let (second, [has, _]) = crowd(&fixture);
    assert_eq!(has, format!("has {}", CLIENTS / 4));
    drop(endpoint);
    assert!(first.stop().success() && second.stop().success());
    fixture.end();
}
