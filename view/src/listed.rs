//! The list of parameters, which all pages share: however many pages look at it, the nodes are asked by one of them at
//! a time.

use std::{
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use serde_json::Value;
use sinew::Time;

/// The latest list.
#[derive(Debug, Default)]
pub(crate) struct Listed {
    /// Held while the nodes are asked.
    turn: tokio::sync::Mutex<()>,
    latest: Mutex<Latest>,
}

#[derive(Debug, Default)]
struct Latest {
    /// When the nodes were asked, and their answer.
    list: Option<(Time, Value)>,
    /// Number of sets, after each of which the list is asked for again.
    sets: u64,
}

impl Listed {
    /// Returns the latest list if it is no older than `fresh` and nothing was set since, else asks for it.
    pub(crate) async fn get<A>(&self, fresh: Duration, ask: impl FnOnce() -> A) -> Result<Value, String>
    where
        A: Future<Output = Result<Value, String>>,
    {
        let _turn = self.turn.lock().await;
        let sets = {
            let latest = self.lock();
            if let Some((asked, list)) = &latest.list
                && Time::now().since(*asked) < fresh
            {
                return Ok(list.clone());
            }
            latest.sets
        };
        let asked = Time::now();
        let list = ask().await?;
        let mut latest = self.lock();
        if latest.sets == sets {
            latest.list = Some((asked, list.clone()));
        }
        Ok(list)
    }

    /// Notes that values were set.
    pub(crate) fn forget(&self) {
        let mut latest = self.lock();
        *latest = Latest { list: None, sets: latest.sets + 1 };
    }

    fn lock(&self) -> MutexGuard<'_, Latest> {
        self.latest.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use serde_json::json;

    use super::*;

    const HOUR: Duration = Duration::from_secs(3_600);

    #[test]
    fn list_is_shared_until_values_are_set() {
        let (listed, count) = (Listed::default(), Cell::new(0));
        let next = || {
            count.set(count.get() + 1);
            json!(count.get())
        };
        let get = |fresh| listed.get(fresh, || async { Ok(next()) });
        let set_meanwhile = || async {
            listed.forget();
            Ok(next())
        };
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        runtime.block_on(async {
            assert_eq!((get(HOUR).await, get(HOUR).await), (Ok(json!(1)), Ok(json!(1))));
            assert_eq!(get(Duration::ZERO).await, Ok(json!(2)));
            listed.forget();
            assert_eq!(get(HOUR).await, Ok(json!(3)));
            // An answer to a question from before a set is not kept.
            assert_eq!(listed.get(Duration::ZERO, set_meanwhile).await, Ok(json!(4)));
            assert_eq!(get(HOUR).await, Ok(json!(5)));
        });
    }

    #[test]
    fn question_without_an_answer_is_asked_again() {
        let listed = Listed::default();
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        runtime.block_on(async {
            let fault = listed.get(HOUR, || async { Err("no answer".to_owned()) }).await;
            assert_eq!(fault, Err("no answer".to_owned()));
            assert_eq!(listed.get(HOUR, || async { Ok(json!(1)) }).await, Ok(json!(1)));
        });
    }
}
