//! One stream of all connections' events for the shell. An actor polls each of its streams whenever one of
//! them is ready. With a stream per connection, each event would cost as much as there are peers.

use std::{
    cell::RefCell,
    pin::Pin,
    rc::Rc,
    task::{Context, Poll, Waker},
};

use futures_util::{
    Stream, StreamExt as _,
    stream::{AbortHandle, SelectAll, abortable},
};

/// A merged stream that polls only the ready members. A member that ends is dropped, and its panic appears in
/// the polling task.
pub(super) struct ConnectionEvents<T>(Rc<RefCell<Members<T>>>);

struct Members<T> {
    all: SelectAll<Pin<Box<dyn Stream<Item = T>>>>,
    /// The waker of the polling task.
    waiter: Option<Waker>,
}

/// A member of the merged stream, which ends when this is dropped.
#[derive(Debug)]
pub(super) struct EventSource(AbortHandle);

impl Drop for EventSource {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl<T> Default for ConnectionEvents<T> {
    fn default() -> Self {
        Self(Rc::new(RefCell::new(Members { all: SelectAll::new(), waiter: None })))
    }
}

impl<T: 'static> ConnectionEvents<T> {
    /// Adds a stream; its items appear in the merged stream while the returned value exists. Members must not
    /// call this while they are polled.
    pub(super) fn add(&self, events: impl Stream<Item = T> + 'static) -> EventSource {
        let (events, member) = abortable(events);
        let Members { all, waiter } = &mut *self.0.borrow_mut();
        all.push(events.boxed_local());
        waiter.take().into_iter().for_each(Waker::wake);
        EventSource(member)
    }

    /// Returns the stream of all items. It never ends. Only one task may poll it.
    pub(super) fn stream(&self) -> impl Stream<Item = T> + use<T> {
        EventStream(self.0.clone())
    }
}

struct EventStream<T>(Rc<RefCell<Members<T>>>);

impl<T> Stream for EventStream<T> {
    type Item = T;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<T>> {
        let Members { all, waiter } = &mut *self.0.borrow_mut();
        match all.poll_next_unpin(cx) {
            Poll::Ready(Some(events)) => Poll::Ready(Some(events)),
            // There is no member at present.
            Poll::Ready(None) | Poll::Pending => {
                *waiter = Some(cx.waker().clone());
                Poll::Pending
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        cell::Cell,
        panic::{AssertUnwindSafe, catch_unwind},
    };

    use futures_util::{FutureExt as _, stream};
    use tokio::sync::mpsc::{Sender, channel};

    use super::*;

    /// Adds a member that counts how often it is polled. Returns it with the sender of its events.
    fn counted(
        connection_events: &ConnectionEvents<u32>,
        polls: &Rc<Cell<u32>>,
    ) -> (EventSource, Sender<u32>) {
        let (sender, mut receiver) = channel(4);
        let polls = polls.clone();
        let events = stream::poll_fn(move |cx| {
            polls.set(polls.get() + 1);
            receiver.poll_recv(cx)
        });
        (connection_events.add(events), sender)
    }

    #[test]
    fn only_members_with_events_are_polled() {
        const MANY: usize = 1_000;
        let (connection_events, polls) = (ConnectionEvents::default(), Rc::new(Cell::new(0)));
        let all: Vec<_> = (0..MANY).map(|_| counted(&connection_events, &polls)).collect();
        let mut events = connection_events.stream();
        while polls.get() < MANY as u32 {
            assert_eq!(events.next().now_or_never(), None);
        }
        polls.set(0);
        all[700].1.try_send(7).unwrap();
        assert_eq!(events.next().now_or_never(), Some(Some(7)));
        assert_eq!(events.next().now_or_never(), None);
        assert!(polls.get() <= 2, "{} polls for one event", polls.get());
    }

    #[test]
    fn removed_member_is_no_longer_polled() {
        let (connection_events, polls) = (ConnectionEvents::default(), Rc::new(Cell::new(0)));
        let mut events = connection_events.stream();
        assert_eq!(events.next().now_or_never(), None, "there is no member");
        let (first, sender) = counted(&connection_events, &polls);
        sender.try_send(1).unwrap();
        drop(first);
        let (_second, sender) = counted(&connection_events, &polls);
        sender.try_send(2).unwrap();
        assert_eq!(events.next().now_or_never(), Some(Some(2)));
        assert_eq!(events.next().now_or_never(), None);
    }

    #[tokio::test(flavor = "current_thread")]
    async fn first_member_wakes_the_waiter_of_an_empty_stream() {
        let connection_events = Rc::new(ConnectionEvents::default());
        let (mut events, adds) = (connection_events.stream(), connection_events.clone());
        let addition = async move {
            tokio::task::yield_now().await;
            let member = adds.add(stream::iter([7]));
            std::future::pending::<()>().await;
            drop(member);
        };
        tokio::select! {
            event = events.next() => assert_eq!(event, Some(7)),
            () = addition => panic!("it never ends"),
        }
    }

    #[test]
    fn panic_of_a_member_propagates_to_the_poller() {
        let connection_events: ConnectionEvents<u32> = ConnectionEvents::default();
        let _member = connection_events.add(stream::poll_fn(|_| panic!("it breaks")));
        let mut events = connection_events.stream();
        assert!(catch_unwind(AssertUnwindSafe(|| events.next().now_or_never())).is_err());
    }
}
