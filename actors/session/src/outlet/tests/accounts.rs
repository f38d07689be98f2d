//! Any sequence of sends, breaks and cuts: the accounts of an outlet balance.

use proptest::prelude::*;

use super::*;
use crate::counts::Account;

#[derive(Clone, Debug)]
enum Step {
    Submit { class: u8, confirm: bool },
    Room(usize),
    Reconnect,
    Expire,
    ConfirmOldest,
}

fn any_step() -> impl Strategy<Value = Step> {
    prop_oneof![
        6 => (0u8..3, any::<bool>()).prop_map(|(class, confirm)| Step::Submit { class, confirm }),
        4 => (0usize..200).prop_map(Step::Room),
        1 => Just(Step::Reconnect),
        1 => Just(Step::Expire),
        1 => Just(Step::ConfirmOldest),
    ]
}

proptest! {
    /// Every message is accounted for, every receipt is settled once, frames are complete and each class is
    /// in order, for all sizes of writes.
    #[test]
    fn messages_are_accounted_for_and_ordered(steps in proptest::collection::vec(any_step(), 1..80)) {
        let mut bench = Bench::new(0);
        let (mut submitted, mut confirmed, mut number) = (0, Vec::new(), 0u8);
        let (mut seen, mut outcomes) = (Vec::new(), Vec::new());
        for step in steps {
            match step {
                Step::Submit { class, confirm } => {
                    number = number.wrapping_add(1);
                    let class = Class::ALL[usize::from(class)];
                    let mut message = message(class, number);
                    if confirm && class != Class::Stream {
                        message = bench.confirmed(u64::from(number));
                        message.header.class = class;
                        confirmed.push(u64::from(number));
                    }
                    submitted += 1;
                    if let Err(refused) = bench.outlet.submit(message) {
                        refused.message.reject(refused.why);
                    }
                }
                Step::Room(room) => bench.make_room(room),
                Step::Reconnect => {
                    seen.extend(frames(&bench.wire.bytes.lock().unwrap()));
                    bench.outlet.disconnect(bench.link);
                    bench.reconnect(0);
                }
                Step::Expire => drop(bench.outlet.expire(Time::MAX)),
                Step::ConfirmOldest => {
                    let oldest = confirmed.first().copied().unwrap_or_default();
                    let ticket = Ticket { source: tid(0), destination: tid(1), correlation: oldest };
                    bench.outlet.confirm(ticket, Outcome::Delivered);
                }
            }
            outcomes.extend(bench.outcome_log.take());
            let counts = bench.outlet.counts();
            let OutletCounts { sent, superseded, expired, lost, refused } = counts;
            let known = sent + superseded + expired + lost + refused + bench.outlet.waiting() as u64;
            prop_assert_eq!(submitted, known, "{:?}", counts);
            let (account, _) = bench.outlet.account();
            prop_assert_eq!(Account::from(&account).unexplained(), 0, "{:?}", account);
            prop_assert_eq!(submitted, account.taken + account.refused, "{:?}", account);
        }
        seen.extend(frames(&bench.wire.bytes.lock().unwrap()));
        for class in Class::ALL {
            let values: Vec<_> = seen.iter().filter(|m| m.header.class == class).map(|m| m.payload[0]).collect();
            prop_assert!(values.is_sorted(), "{:?} {:?}", class, values);
        }
        bench.outlet.close(Rejection::Closed);
        outcomes.extend(bench.outcome_log.take());
        let mut settled: Vec<_> = outcomes.iter().map(|(correlation, _)| *correlation).collect();
        settled.sort_unstable();
        prop_assert_eq!(settled, confirmed);
    }
}
