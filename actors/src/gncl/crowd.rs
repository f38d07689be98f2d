//! What all connections have to say to the shell, as one stream of it: an actor looks at each of its streams whenever one of them has something,
//! and with a stream for each connection each piece of news would cost as much as there are peers.

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

/// Of such a stream those that have something are looked at, and nobody else. Who goes is dropped, and a panic comes out where it is looked at.
pub(super) struct Crowd<T>(Rc<RefCell<Members<T>>>);

struct Members<T> {
    all: SelectAll<Pin<Box<dyn Stream<Item = T>>>>,
    /// Who looks.
    looks: Option<Waker>,
}

/// One of the crowd, which goes with this.
#[derive(Debug)]
pub(super) struct Member(AbortHandle);

impl Drop for Member {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl<T> Default for Crowd<T> {
    fn default() -> Self {
        Self(Rc::new(RefCell::new(Members { all: SelectAll::new(), looks: None })))
    }
}

impl<T: 'static> Crowd<T> {
    /// What this says is said in the crowd from now on, as long as the member lives. Not to be called by one of them.
    pub(super) fn join(&self, news: impl Stream<Item = T> + 'static) -> Member {
        let (news, member) = abortable(news);
        let Members { all, looks } = &mut *self.0.borrow_mut();
        all.push(news.boxed_local());
        looks.take().into_iter().for_each(Waker::wake);
        Member(member)
    }

    /// All that is said, one after the other. It never ends. For one who looks.
    pub(super) fn news(&self) -> impl Stream<Item = T> + use<T> {
        News(self.0.clone())
    }
}

struct News<T>(Rc<RefCell<Members<T>>>);

impl<T> Stream for News<T> {
    type Item = T;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<T>> {
        let Members { all, looks } = &mut *self.0.borrow_mut();
        match all.poll_next_unpin(cx) {
            Poll::Ready(Some(news)) => Poll::Ready(Some(news)),
            // Nobody is left, for now.
            Poll::Ready(None) | Poll::Pending => {
                *looks = Some(cx.waker().clone());
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

    /// One of a crowd who counts how often it is looked at, and what makes it speak.
    fn counted(crowd: &Crowd<u32>, looks: &Rc<Cell<u32>>) -> (Member, Sender<u32>) {
        let (say, mut said) = channel(4);
        let looks = looks.clone();
        let news = stream::poll_fn(move |cx| {
            looks.set(looks.get() + 1);
            said.poll_recv(cx)
        });
        (crowd.join(news), say)
    }

    #[test]
    fn of_many_only_who_has_something_is_looked_at() {
        const MANY: usize = 1_000;
        let (crowd, looks) = (Crowd::default(), Rc::new(Cell::new(0)));
        let all: Vec<_> = (0..MANY).map(|_| counted(&crowd, &looks)).collect();
        let mut news = crowd.news();
        while looks.get() < MANY as u32 {
            assert_eq!(news.next().now_or_never(), None);
        }
        looks.set(0);
        all[700].1.try_send(7).unwrap();
        assert_eq!(news.next().now_or_never(), Some(Some(7)));
        assert_eq!(news.next().now_or_never(), None);
        assert!(looks.get() <= 2, "{} looks for one piece of news", looks.get());
    }

    #[test]
    fn who_has_gone_says_nothing_and_who_comes_is_looked_at() {
        let (crowd, looks) = (Crowd::default(), Rc::new(Cell::new(0)));
        let mut news = crowd.news();
        assert_eq!(news.next().now_or_never(), None, "nobody is there");
        let (first, say) = counted(&crowd, &looks);
        say.try_send(1).unwrap();
        drop(first);
        let (_second, say) = counted(&crowd, &looks);
        say.try_send(2).unwrap();
        assert_eq!(news.next().now_or_never(), Some(Some(2)));
        assert_eq!(news.next().now_or_never(), None);
    }

    #[tokio::test(flavor = "current_thread")]
    async fn whoever_waits_for_a_crowd_in_which_nobody_was_is_woken_by_the_first_one() {
        let crowd = Rc::new(Crowd::default());
        let (mut news, joins) = (crowd.news(), crowd.clone());
        let comes = async move {
            tokio::task::yield_now().await;
            let member = joins.join(stream::iter([7]));
            std::future::pending::<()>().await;
            drop(member);
        };
        tokio::select! {
            said = news.next() => assert_eq!(said, Some(7)),
            () = comes => panic!("it never ends"),
        }
    }

    #[test]
    fn a_panic_of_one_comes_out_where_all_are_looked_at() {
        let crowd: Crowd<u32> = Crowd::default();
        let _member = crowd.join(stream::poll_fn(|_| panic!("it breaks")));
        let mut news = crowd.news();
        assert!(catch_unwind(AssertUnwindSafe(|| news.next().now_or_never())).is_err());
    }
}
