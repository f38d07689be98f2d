//! Tests of `src/robot/launch/children.rs`.

use std::os::unix::net::UnixListener;

use super::*;

#[test]
fn only_sockets_without_a_listener_are_removed() {
    // given: a socket with a listener, and one left by a killed listener
    let id = std::process::id();
    let [dead, living] =
        ["dead", "living"].map(|name| std::env::temp_dir().join(format!("exo-{name}-{id}.s")));
    drop(UnixListener::bind(&dead).unwrap());
    let listener = UnixListener::bind(&living).unwrap();
    assert!(dead.exists() && living.exists());
    // when
    remove_if_dead(&dead);
    remove_if_dead(&living);
    // then
    assert!(!dead.exists() && living.exists());
    drop(listener);
    remove_if_dead(&living);
    assert!(!living.exists());
}
