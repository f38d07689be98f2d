//! Tests of `src/robot/drive/damping_repeater.rs`.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use super::*;

const DEADLINE: Duration = Duration::from_secs(60);

impl Damper for SyncSender<()> {
    fn damp(&self, _: Time, _: DriveState) {
        // The test may have stopped reading.
        let _ = self.try_send(());
    }
}

fn repeater() -> (DampingRepeater, Receiver<()>) {
    let (damper, orders) = sync_channel(ORDERS_MAX as usize);
    (DampingRepeater::start(Box::new(damper)).expect("a thread"), orders)
}

#[track_caller]
fn expect_orders(orders: &Receiver<()>, times: u32) {
    for time in 1..=times {
        orders.recv_timeout(DEADLINE).unwrap_or_else(|_| panic!("no order {time} of {times}"));
    }
}

#[test]
fn order_to_damp_is_repeated_within_a_bound() {
    let (repeater, orders) = repeater();
    repeater.handle().damps();
    expect_orders(&orders, ORDERS_MAX);
    // Long enough for many more, which would keep the device from accepting the next incarnation.
    assert!(orders.recv_timeout(PERIOD * ORDERS_MAX).is_err());
    repeater.handle().damps();
    expect_orders(&orders, ORDERS_MAX);
}

#[test]
fn silence_during_a_ramp_orders_the_device_to_damp() {
    let (repeater, orders) = repeater();
    repeater.handle().ramps();
    expect_orders(&orders, 2);
}

#[test]
fn idle_device_gets_no_order() {
    let (repeater, orders) = repeater();
    repeater.handle().rests();
    drop(repeater);
    // The thread has the only sender: it is gone when this returns.
    assert_eq!(orders.recv_timeout(DEADLINE), Err(std::sync::mpsc::RecvTimeoutError::Disconnected));
}

#[test]
fn drive_that_ends_after_its_orders_sends_no_more() {
    let (repeater, orders) = repeater();
    repeater.handle().damps();
    expect_orders(&orders, ORDERS_MAX);
    drop(repeater);
    assert_eq!(orders.recv_timeout(DEADLINE), Err(std::sync::mpsc::RecvTimeoutError::Disconnected));
}

#[test]
fn drive_ending_while_damping_sends_last_orders() {
    let (repeater, orders) = repeater();
    repeater.handle().damps();
    expect_orders(&orders, 1);
    drop(repeater);
    expect_orders(&orders, LAST_ORDERS);
    while orders.recv_timeout(DEADLINE).is_ok() {}
}
