//! Checks the thread placement that applications request.

use sinew_runtime::{protection::SAFE_OUTPUT_PRIORITY, supervision::Place};

use super::StartError;

/// Refuses the application `name` if its priority is not below that of the threads that make outputs safe.
/// Also refuses it if its thread, the node's own or one of `others`, already has another priority or CPU.
pub(super) fn check<'a>(
    name: &str,
    place: &Place,
    others: impl IntoIterator<Item = (&'a str, &'a Place)>,
) -> Result<(), StartError> {
    let clash = match Place::io().clash(place) {
        _ if place.realtime_priority.max(place.at_best) >= Some(SAFE_OUTPUT_PRIORITY) => {
            let most = SAFE_OUTPUT_PRIORITY - 1;
            Some(format!(
                "its thread is to have a real-time priority of {SAFE_OUTPUT_PRIORITY} or more, which what makes outputs safe would wait for; \
                 take one of 1 to {most}"
            ))
        }
        Some(why) => {
            Some(format!("{why}; it is the node's: take `Place::thread` or `Place::own_thread` for that"))
        }
        None => others.into_iter().find_map(|(other, theirs)| {
            let why = theirs.clash(place)?;
            Some(format!(
                "{why}: so '{other}' asked before it; give both the same, or one of them another thread"
            ))
        }),
    };
    clash.map_or(Ok(()), |why| Err(StartError::Application { name: name.to_owned(), why }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changing_the_node_thread_suggests_alternative() {
        let words = |place| check("control", &place, []).expect_err("it is refused").to_string();
        assert_eq!(
            words(Place::io().realtime(50)),
            "application 'control' cannot be registered: the thread 'io' has no real-time priority on any CPU, and cannot \
             have real-time priority 50 on any CPU as well; it is the node's: take `Place::thread` or `Place::own_thread` \
             for that"
        );
        for place in [Place::io(), Place::thread("io").realtime(50), Place::process().realtime(50)] {
            assert!(check("control", &place, []).is_ok(), "{place:?}");
        }
    }

    #[test]
    fn no_priority_may_delay_the_safety_watchdog() {
        for place in [Place::own_thread(), Place::process(), Place::thread("leg")] {
            assert!(check("control", &place.clone().realtime(89), []).is_ok());
            for high in [place.clone().realtime(90), place.clone().realtime(99), place.realtime_at_best(90)] {
                let words = check("control", &high, []).expect_err("it is refused").to_string();
                assert!(words.contains("'control'") && words.contains("take one of 1 to 89"), "{words}");
            }
        }
    }

    #[test]
    fn conflicting_thread_settings_name_both_applications() {
        let fast = Place::thread("leg").realtime(50);
        let others = [("apps", &Place::thread("apps")), ("knee", &fast)];
        let error =
            check("hip", &Place::thread("leg"), others).expect_err("one of them would have been lost");
        let words = error.to_string();
        assert!(words.contains("'hip'") && words.contains("'knee' asked before it"), "{words}");
        assert!(check("hip", &fast, others).is_ok());
    }
}
