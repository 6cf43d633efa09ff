//! Permits for which callers take turns, so that whoever asks often does not push out whoever asks
//! seldom.
//!
//! Each caller has a line of its own, in which the first to wait is the first to be served. A
//! permit that becomes free goes to the caller whose turn it is, and that caller then goes to the
//! end of the round. A newcomer, who had no turn since the round last passed it, goes before the
//! round; of several, the one that had no turn for the longest. So a vehicle that asks now and then
//! waits for hardly anybody, although others always have requests waiting. Routers order flows of
//! packets like that (RFC 8290, 4.1). But the round is never kept waiting for more than a few
//! newcomers in a row, because anybody can have many addresses.
//!
//! So a request waits for at most two others of each caller per request of its own caller that is
//! ahead of it, however long the lines of the others are.
//!
//! Long work may lend its permit in between, to a newcomer that asks for less than half of its
//! share. So the wait of a vehicle is shorter than the work of another, too.
//!
//! Whoever has time may wait behind the lines: it is served when nobody is left in them who came
//! before it. So one who comes to a line waits for those only who waited behind the lines already.

use super::caller::Caller;
use std::cell::Cell;
use std::collections::{HashMap, HashSet, VecDeque};
use std::hash::Hash;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// A number of permits for which callers take turns. Clones share the permits.
#[derive(Clone)]
pub(super) struct FairSemaphore(Arc<Mutex<State>>);

struct State {
    /// Permits that nobody has. While there are any, nobody waits.
    free: usize,
    lines: Turns<Caller, Waiting>,
    /// Those who wait behind the lines, the first first.
    behind: VecDeque<Waiting>,
    /// Counts those who had to wait, so that it is known who came first.
    arrivals: u64,
}

/// One who waits.
struct Waiting {
    arrival: u64,
    granted: oneshot::Sender<FairPermit>,
}

/// How often a permit is lent at most, so that its work ends however many ask for it.
const LENT_AT_MOST: u32 = 2;

/// A permit; given back when dropped.
pub(super) struct FairPermit {
    semaphore: FairSemaphore,
    /// Who lent it, and waits to have it back.
    lender: Option<mpsc::SyncSender<()>>,
    lent: Cell<u32>,
}

impl FairSemaphore {
    pub(super) fn new(permits: usize) -> Self {
        Self(Arc::new(Mutex::new(State {
            free: permits,
            lines: Turns::default(),
            behind: VecDeque::new(),
            arrivals: 0,
        })))
    }

    /// Waits for a permit in the line of `caller`.
    ///
    /// Cancel safety: dropped while waiting, the request leaves the line; a permit that it was
    /// granted at that moment goes to the next.
    pub(super) async fn acquire(&self, caller: &Caller) -> FairPermit {
        self.acquire_in(Some(caller)).await
    }

    /// Waits for a permit behind those who are in the lines now.
    ///
    /// Cancel safety: as of [`FairSemaphore::acquire`].
    pub(super) async fn acquire_behind(&self) -> FairPermit {
        self.acquire_in(None).await
    }

    async fn acquire_in(&self, line: Option<&Caller>) -> FairPermit {
        let mut place = {
            let mut state = self.lock();
            if state.free > 0 {
                state.free -= 1;
                if let Some(caller) = line {
                    state.lines.remember(caller.clone());
                }
                return self.permit(None);
            }
            state.enqueue(self, line)
        };
        let granted = (&mut place.granted).await;
        // The sender stays in the line until it sends or `place` is dropped.
        granted.expect("whoever waits is granted a permit")
    }

    fn permit(&self, lender: Option<mpsc::SyncSender<()>>) -> FairPermit {
        FairPermit {
            semaphore: self.clone(),
            lender,
            lent: Cell::new(0),
        }
    }

    /// Hands a permit that was given back to the next.
    fn release(&self) {
        let next = {
            let mut state = self.lock();
            let next = state.next();
            state.free += usize::from(next.is_none());
            next
        };
        if let Some(next) = next {
            // If it has just stopped waiting, the permit comes back here and goes to the next.
            drop(next.granted.send(self.permit(None)));
        }
    }

    // A thread that panics with the lock leaves the state whole, because nothing between its
    // changes can panic. So a poisoned lock can be used all the same.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl FairPermit {
    /// Lends the permit to a newcomer that asks for less than half of its share, if one waits, and
    /// blocks until it is given back; returns how long that took.
    ///
    /// A permit is lent twice at most, and never lent on: so nobody's work is kept waiting without
    /// end, and at most two have begun and not ended for each permit.
    pub(super) fn lend(&self) -> Duration {
        if self.lender.is_some() || self.lent.get() == LENT_AT_MOST {
            return Duration::ZERO;
        }
        let Some(borrower) = self.semaphore.lock().lines.pop_seldom() else {
            return Duration::ZERO;
        };
        let since = Instant::now();
        self.lent.set(self.lent.get() + 1);
        let (give_back, given_back) = mpsc::sync_channel(1);
        drop(
            borrower
                .granted
                .send(self.semaphore.permit(Some(give_back))),
        );
        // The other end is gone only together with the permit.
        let _ = given_back.recv();
        since.elapsed()
    }
}

impl Drop for FairPermit {
    fn drop(&mut self) {
        match self.lender.take() {
            // It waits for this, so that it receives it.
            Some(lender) => drop(lender.send(())),
            None => self.semaphore.release(),
        }
    }
}

impl State {
    fn enqueue(&mut self, semaphore: &FairSemaphore, line: Option<&Caller>) -> Place {
        let (granted, receiver) = oneshot::channel();
        let arrival = self.arrivals;
        self.arrivals += 1;
        let waiting = Waiting { arrival, granted };
        match line {
            Some(caller) => self.lines.push(caller.clone(), waiting),
            None => self.behind.push_back(waiting),
        }
        Place {
            semaphore: semaphore.clone(),
            line: line.cloned(),
            arrival,
            granted: receiver,
        }
    }

    /// Takes out who is served next.
    fn next(&mut self) -> Option<Waiting> {
        let first_behind = self.behind.front().map(|waiting| waiting.arrival);
        let oldest = self.lines.fronts().map(|waiting| waiting.arrival).min();
        match (first_behind, oldest) {
            (Some(behind), Some(oldest)) if oldest < behind => self.lines.pop(),
            (Some(_), _) => self.behind.pop_front(),
            (None, _) => self.lines.pop(),
        }
    }

    /// Takes out one who stops waiting, unless it has been granted a permit already.
    fn remove(&mut self, line: Option<&Caller>, arrival: u64) {
        match line {
            Some(caller) => self
                .lines
                .remove(caller, |waiting| waiting.arrival == arrival),
            None => self.behind.retain(|waiting| waiting.arrival != arrival),
        }
    }
}

/// A place in a line, or behind the lines, of one who waits.
struct Place {
    semaphore: FairSemaphore,
    line: Option<Caller>,
    arrival: u64,
    granted: oneshot::Receiver<FairPermit>,
}

impl Drop for Place {
    /// Leaves the line. A permit that was granted at this moment is dropped with the receiver.
    fn drop(&mut self) {
        self.semaphore
            .lock()
            .remove(self.line.as_ref(), self.arrival);
    }
}

/// How many newcomers are served in a row while the round waits. Those beyond go to its end.
const NEWCOMERS_IN_A_ROW: usize = 4;

/// So many turns are remembered, to tell how seldom a newcomer asks.
const REMEMBERED_TURNS: usize = 64;

/// Lines of values, one for each key, that are served in turn.
struct Turns<K, V> {
    /// No line is empty.
    lines: HashMap<K, VecDeque<V>>,
    /// Keys that have a line and are not in the round, the one that had no turn for the longest
    /// first.
    newcomers: VecDeque<K>,
    /// Keys that had a turn, the one whose turn it is first. One without a line stays until the
    /// round passes it, so that it is no newcomer before everybody else had a turn.
    round: VecDeque<K>,
    /// How many newcomers were served since the round was.
    newcomers_in_a_row: usize,
    /// Who had the last turns, the latest last.
    history: VecDeque<K>,
}

impl<K, V> Default for Turns<K, V> {
    fn default() -> Self {
        Self {
            lines: HashMap::new(),
            newcomers: VecDeque::new(),
            round: VecDeque::new(),
            newcomers_in_a_row: 0,
            history: VecDeque::new(),
        }
    }
}

impl<K: Clone + Eq + Hash, V> Turns<K, V> {
    /// Adds a value to the end of the line of `key`.
    fn push(&mut self, key: K, value: V) {
        if !self.lines.contains_key(&key) && !self.round.contains(&key) {
            let last = self.last_turn(&key);
            let is_later = |other: &K| self.last_turn(other) > last;
            let place = self.newcomers.iter().position(is_later);
            let place = place.unwrap_or(self.newcomers.len());
            self.newcomers.insert(place, key.clone());
        }
        self.lines.entry(key).or_default().push_back(value);
    }

    /// When a key had its last turn: the later, the greater; none if that is long ago.
    fn last_turn(&self, key: &K) -> Option<usize> {
        self.history.iter().rposition(|other| other == key)
    }

    /// Takes the first value of the line whose turn it is; its key goes to the end of the round.
    fn pop(&mut self) -> Option<V> {
        while self
            .round
            .front()
            .is_some_and(|key| !self.lines.contains_key(key))
        {
            self.round.pop_front();
        }
        let key = self.next_key()?;
        self.take_turn(key)
    }

    /// Takes the first value of the line of `key`, which goes to the end of the round.
    fn take_turn(&mut self, key: K) -> Option<V> {
        let line = self.lines.get_mut(&key)?;
        let value = line.pop_front();
        if line.is_empty() {
            self.lines.remove(&key);
        }
        self.round.push_back(key.clone());
        self.remember(key);
        value
    }

    /// Remembers that `key` had a turn.
    fn remember(&mut self, key: K) {
        if self.history.len() == REMEMBERED_TURNS {
            self.history.pop_front();
        }
        self.history.push_back(key);
    }

    /// Takes out the key whose turn it is.
    fn next_key(&mut self) -> Option<K> {
        if self.newcomers_in_a_row == NEWCOMERS_IN_A_ROW && !self.round.is_empty() {
            // They wait for one round like everybody else, and so nobody is served a second time
            // before them.
            self.round.append(&mut self.newcomers);
        }
        if let Some(newcomer) = self.newcomers.pop_front() {
            self.newcomers_in_a_row = (self.newcomers_in_a_row + 1).min(NEWCOMERS_IN_A_ROW);
            return Some(newcomer);
        }
        self.newcomers_in_a_row = 0;
        self.round.pop_front()
    }

    /// Takes the first value of the first newcomer, if that asks for less than half of its share:
    /// if so many turns have passed since its own that each of the others had two.
    fn pop_seldom(&mut self) -> Option<V> {
        let newcomer = self.newcomers.front()?;
        let turns_since = match self.last_turn(newcomer) {
            Some(last) => self.history.len() - 1 - last,
            None => self.history.len(),
        };
        let others: HashSet<&K> = self.history.iter().filter(|key| *key != newcomer).collect();
        if turns_since < 2 * others.len().max(1) {
            return None;
        }
        let newcomer = self.newcomers.pop_front()?;
        self.take_turn(newcomer)
    }

    /// Takes a value for which `is_it` holds out of the line of `key`, if there is one.
    fn remove(&mut self, key: &K, is_it: impl Fn(&V) -> bool) {
        let Some(line) = self.lines.get_mut(key) else {
            return;
        };
        line.retain(|value| !is_it(value));
        if line.is_empty() {
            self.lines.remove(key);
            self.newcomers.retain(|other| other != key);
        }
    }

    /// The first value of each line.
    fn fronts(&self) -> impl Iterator<Item = &V> {
        self.lines.values().filter_map(VecDeque::front)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures_util::FutureExt;
    use futures_util::future::BoxFuture;
    use proptest::prelude::*;

    fn caller(name: usize) -> Caller {
        Caller::Key(name.to_string().into())
    }

    /// A waiter that has been polled once, so that it is in its line.
    fn queued<'a>(
        waiting: impl Future<Output = FairPermit> + Send + 'a,
    ) -> BoxFuture<'a, FairPermit> {
        let mut waiting = waiting.boxed();
        assert!(
            (&mut waiting).now_or_never().is_none(),
            "nobody had to wait"
        );
        waiting
    }

    /// The permit, if it was granted.
    fn granted(waiting: &mut BoxFuture<'_, FairPermit>) -> Option<FairPermit> {
        waiting.now_or_never()
    }

    #[derive(Debug, Clone, Copy)]
    enum Step {
        /// This caller asks for a permit.
        Ask(usize),
        /// The permit is given back, and the next who waits gets it.
        Serve,
        /// Of those who wait, this one leaves.
        Leave(usize),
    }

    fn steps() -> impl Strategy<Value = Vec<Step>> {
        let step = prop_oneof![
            4 => (0usize..4).prop_map(Step::Ask),
            // One caller asks as often as all others together.
            4 => Just(Step::Ask(0)),
            3 => Just(Step::Serve),
            1 => (0usize..50).prop_map(Step::Leave),
        ];
        prop::collection::vec(step, 1..200)
    }

    proptest! {
        #[test]
        fn callers_take_turns_and_each_keeps_its_order(steps in steps()) {
            let semaphore = FairSemaphore::new(1);
            let mut held = Some(semaphore.acquire(&caller(9)).now_or_never().unwrap());
            let names: Vec<Caller> = (0..4).map(caller).collect();
            let mut waiting: Vec<(usize, BoxFuture<'_, FairPermit>)> = Vec::new();
            // Of each caller that waits: whom it has seen being served since it began to.
            let mut seen: HashMap<usize, Vec<usize>> = HashMap::new();
            for step in steps.into_iter().chain(std::iter::repeat_n(Step::Serve, 200)) {
                match step {
                    Step::Ask(name) => {
                        if !waiting.iter().any(|(other, _)| *other == name) {
                            seen.insert(name, Vec::new());
                        }
                        waiting.push((name, queued(semaphore.acquire(&names[name]))));
                    }
                    Step::Leave(which) if !waiting.is_empty() => {
                        let (name, future) = waiting.remove(which % waiting.len());
                        drop(future);
                        if !waiting.iter().any(|(other, _)| *other == name) {
                            seen.remove(&name);
                        }
                    }
                    Step::Leave(_) => {}
                    Step::Serve => {
                        drop(held.take());
                        let served = (0..waiting.len())
                            .find_map(|i| granted(&mut waiting[i].1).map(|permit| (i, permit)));
                        let Some((position, permit)) = served else {
                            prop_assert!(waiting.is_empty());
                            held = Some(semaphore.acquire(&names[0]).now_or_never().unwrap());
                            continue;
                        };
                        held = Some(permit);
                        let (name, _) = waiting.remove(position);
                        prop_assert!(
                            waiting[..position].iter().all(|(other, _)| *other != name),
                            "one of {name} was served before another of it that came first"
                        );
                        for (other, served) in &mut seen {
                            let times = served.iter().filter(|served| **served == name).count();
                            prop_assert!(
                                *other == name || times < 2,
                                "{name} was served three times while {other} waited for its turn"
                            );
                            served.push(name);
                        }
                        if waiting.iter().any(|(other, _)| *other == name) {
                            seen.insert(name, Vec::new());
                        } else {
                            seen.remove(&name);
                        }
                    }
                }
            }
            prop_assert!(waiting.is_empty(), "{} were never served", waiting.len());
        }
    }

    /// Serves everybody; returns the names in the order in which they were served.
    fn order_of(held: FairPermit, waiting: Vec<(usize, BoxFuture<'_, FairPermit>)>) -> Vec<usize> {
        let mut waiting = waiting;
        let mut order = Vec::new();
        let mut held = Some(held);
        while !waiting.is_empty() {
            drop(held.take());
            let (position, permit) = (0..waiting.len())
                .find_map(|i| granted(&mut waiting[i].1).map(|permit| (i, permit)))
                .expect("a free permit was granted to nobody");
            held = Some(permit);
            order.push(waiting.remove(position).0);
        }
        order
    }

    #[test]
    fn who_asks_seldom_is_served_before_those_who_always_wait() {
        let semaphore = FairSemaphore::new(1);
        let names: Vec<Caller> = (0..4).map(caller).collect();
        let ask = |name: usize| (name, queued(semaphore.acquire(&names[name])));
        let mut held = semaphore.acquire(&caller(9)).now_or_never().unwrap();
        let mut waiting = vec![ask(0), ask(0), ask(1), ask(1), ask(2), ask(2)];
        // Everybody has a turn, so that nobody is a newcomer any more.
        for position in [0, 2, 4] {
            drop(held);
            held = granted(&mut waiting[position].1).expect("the turn of another");
        }
        let mut waiting: Vec<_> = waiting.into_iter().skip(1).step_by(2).collect();
        waiting.push(ask(3));
        waiting.push(ask(3));
        let order = order_of(held, waiting);
        assert_eq!(
            order,
            [3, 0, 1, 2, 3],
            "the second of the newcomer waits for the round"
        );
    }

    #[test]
    fn of_newcomers_the_one_who_asks_least_is_served_first() {
        let semaphore = FairSemaphore::new(1);
        let names: Vec<Caller> = (0..4).map(caller).collect();
        let ask = |name: usize| (name, queued(semaphore.acquire(&names[name])));
        // Nobody has to wait, so that the round is empty.
        for name in [0, 1, 2, 1] {
            drop(semaphore.acquire(&names[name]).now_or_never());
        }
        let held = semaphore.acquire(&caller(9)).now_or_never().unwrap();
        let waiting = vec![ask(1), ask(2), ask(0), ask(3)];
        assert_eq!(order_of(held, waiting), [3, 0, 2, 1]);
    }

    #[test]
    fn newcomers_without_end_do_not_keep_the_round_waiting() {
        let semaphore = FairSemaphore::new(1);
        let names: Vec<Caller> = (0..20).map(caller).collect();
        let ask = |name: usize| (name, queued(semaphore.acquire(&names[name])));
        let held = semaphore.acquire(&names[0]).now_or_never().unwrap();
        let mut first = queued(semaphore.acquire(&names[0]));
        let mut waiting = vec![ask(0), ask(0)];
        drop(held);
        let held = granted(&mut first).expect("nobody else waits");
        waiting.extend((1..20).map(ask));
        let order = order_of(held, waiting);
        // The first of all was a newcomer, too.
        assert_eq!(order[..4], [1, 2, 3, 0]);
        let second = order.iter().rposition(|name| *name == 0);
        assert_eq!(
            second,
            Some(20),
            "each newcomer is served before the same one again"
        );
    }

    #[test]
    fn a_permit_is_lent_to_one_who_asks_seldom_and_comes_back() {
        let semaphore = FairSemaphore::new(1);
        let [often, seldom, other, third] = [0, 1, 2, 3].map(caller);
        for _ in 0..4 {
            drop(semaphore.acquire(&often).now_or_never());
        }
        let mut lender = semaphore.acquire(&often).now_or_never().unwrap();
        assert_eq!(lender.lend(), Duration::ZERO, "nobody wants it");
        let mut same = queued(semaphore.acquire(&often));
        assert_eq!(lender.lend(), Duration::ZERO, "its own caller has to wait");
        for borrower in [&seldom, &other] {
            let mut waiting = queued(semaphore.acquire(borrower));
            let (given_back, lent) = std::thread::scope(|scope| {
                let lending = scope.spawn(move || {
                    let lent = lender.lend();
                    (lender, lent)
                });
                let borrowed = loop {
                    match granted(&mut waiting) {
                        Some(borrowed) => break borrowed,
                        None => std::thread::yield_now(),
                    }
                };
                let waiting = queued(semaphore.acquire(&third));
                assert_eq!(borrowed.lend(), Duration::ZERO, "it is never lent on");
                assert!(!lending.is_finished());
                drop((waiting, borrowed));
                lending.join().unwrap()
            });
            assert!(lent > Duration::ZERO);
            lender = given_back;
        }
        let mut newcomer = queued(semaphore.acquire(&third));
        assert_eq!(lender.lend(), Duration::ZERO, "it was lent twice already");
        drop(lender);
        drop(granted(&mut newcomer).expect("a newcomer goes first"));
        assert!(granted(&mut same).is_some());
    }

    #[test]
    fn a_permit_lent_to_one_who_leaves_comes_back() {
        let semaphore = FairSemaphore::new(1);
        let [often, seldom] = [caller(0), caller(1)];
        for _ in 0..4 {
            drop(semaphore.acquire(&often).now_or_never());
        }
        let lender = semaphore.acquire(&often).now_or_never().unwrap();
        let leaving = queued(semaphore.acquire(&seldom));
        std::thread::scope(|scope| {
            let lending = scope.spawn(move || {
                lender.lend();
                lender
            });
            while semaphore.lock().lines.fronts().count() > 0 {
                std::thread::yield_now();
            }
            drop(leaving);
            drop(lending.join().unwrap());
        });
        assert!(semaphore.acquire(&often).now_or_never().is_some());
    }

    #[test]
    fn a_permit_granted_to_one_who_leaves_goes_to_the_next() {
        let semaphore = FairSemaphore::new(1);
        let [a, b] = [caller(0), caller(1)];
        let held = semaphore.acquire(&a).now_or_never().unwrap();
        let leaving = queued(semaphore.acquire(&a));
        let mut staying = queued(semaphore.acquire(&b));
        drop(held);
        drop(leaving);
        let permit = granted(&mut staying).expect("the permit was lost");
        drop(permit);
        assert!(semaphore.acquire(&a).now_or_never().is_some());
    }

    #[test]
    fn those_behind_are_served_when_nobody_is_left_who_came_before_them() {
        let semaphore = FairSemaphore::new(1);
        let one = caller(0);
        let held = semaphore.acquire(&one).now_or_never().unwrap();
        let mut early = queued(semaphore.acquire(&one));
        let mut behind = queued(semaphore.acquire_behind());
        let mut late = queued(semaphore.acquire(&one));
        drop(held);
        assert!(granted(&mut behind).is_none());
        drop(granted(&mut early).unwrap());
        drop(granted(&mut behind).unwrap());
        let permit = granted(&mut late).unwrap();
        let mut next_behind = queued(semaphore.acquire_behind());
        let mut latest = queued(semaphore.acquire(&one));
        drop(permit);
        drop(granted(&mut next_behind).unwrap());
        drop(granted(&mut latest).unwrap());
    }

    #[test]
    fn as_many_as_there_are_permits_are_served_at_once() {
        let semaphore = FairSemaphore::new(3);
        let names: Vec<Caller> = (0..4).map(caller).collect();
        let held: Vec<_> = names[..3]
            .iter()
            .map(|name| semaphore.acquire(name).now_or_never().unwrap())
            .collect();
        let mut fourth = queued(semaphore.acquire(&names[3]));
        assert!(granted(&mut fourth).is_none());
        drop(held);
        assert!(granted(&mut fourth).is_some());
    }
}
