//! Whether a barrier opened early, from what the parties wrote down.

use std::time::Duration;

use super::PARTIES;
use crate::load::Times;

/// So long after a process was killed its arrival may still be counted by those who have not heard of it: a lost node is known
/// after three missed answers at the latest.
const HEARSAY: Duration = Duration::from_secs(3);

/// What a party wrote down, with the host's monotonic time in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// All that it requires was ready.
    Started(u64),
    /// It is about to arrive.
    Arrived(u64),
    /// It has passed this generation.
    Passed(u64, u64),
}

impl Event {
    /// Says it, in a line.
    pub fn tell(self) {
        match self {
            Self::Started(at) => println!("started {at}"),
            Self::Arrived(at) => println!("arrived {at}"),
            Self::Passed(at, generation) => println!("passed {at} {generation}"),
        }
    }

    /// What a line says; `None`: something else.
    #[must_use]
    pub fn read(line: &str) -> Option<Self> {
        let mut words = line.split(' ');
        let (what, at) = (words.next()?, words.next()?.parse().ok()?);
        match what {
            "started" => Some(Self::Started(at)),
            "arrived" => Some(Self::Arrived(at)),
            "passed" => Some(Self::Passed(at, words.next()?.parse().ok()?)),
            _ => None,
        }
    }
}

/// What one process wrote down, and when it was killed.
#[derive(Clone, Debug, Default)]
pub struct Life {
    /// In the order in which it happened.
    pub events: Vec<Event>,
    /// By the same clock.
    pub killed: Option<u64>,
}

/// A wait of one life.
struct Visit {
    at: u64,
    passed: Option<(u64, u64)>,
}

/// What the judge found.
#[derive(Debug, Default)]
pub struct Verdict {
    /// What must not have happened, in words.
    pub violations: Vec<String>,
    /// Generations that all parties passed, each in one life.
    pub generations: usize,
    /// From the last arrival until the last one has gone on.
    pub release: Times,
    /// From the first one that goes on until the last one does.
    pub skew: Times,
}

impl Life {
    fn started(&self) -> Option<u64> {
        self.events.iter().find_map(|event| if let Event::Started(at) = event { Some(*at) } else { None })
    }

    /// Whether what it did at `then` may count at `at`.
    fn counts(&self, then: u64, at: u64) -> bool {
        let end = self.killed.map_or(u64::MAX, |killed| killed.saturating_add(HEARSAY.as_nanos() as u64));
        then <= at && at <= end
    }

    fn visits(&self) -> Vec<Visit> {
        let mut visits: Vec<Visit> = Vec::new();
        for event in &self.events {
            match *event {
                Event::Started(_) => {}
                Event::Arrived(at) => visits.push(Visit { at, passed: None }),
                Event::Passed(at, generation) => {
                    if let Some(visit) = visits.last_mut() {
                        visit.passed = Some((at, generation));
                    }
                }
            }
        }
        visits
    }
}

impl Verdict {
    /// Reads what all lives of all parties wrote down.
    #[must_use]
    pub fn of(parties: &[Vec<Life>]) -> Self {
        let mut verdict = Self::default();
        verdict.judge_starts(parties);
        let visits: Vec<Vec<(&Life, Vec<Visit>)>> =
            parties.iter().map(|lives| lives.iter().map(|life| (life, life.visits())).collect()).collect();
        for (index, lives) in visits.iter().enumerate() {
            for (_, of_life) in lives {
                verdict.judge_life(index, of_life, &visits);
            }
        }
        verdict.measure(&visits);
        verdict
    }

    /// Nobody starts before what it requires.
    fn judge_starts(&mut self, parties: &[Vec<Life>]) {
        for (index, lives) in parties.iter().enumerate() {
            for at in lives.iter().filter_map(Life::started) {
                let is_there = |other: usize| {
                    parties[other].iter().any(|life| life.started().is_some_and(|then| life.counts(then, at)))
                };
                for text in PARTIES[index].1 {
                    let requirement: sinew::Requirement = text.parse().expect("they are written by us");
                    let there = (0..PARTIES.len())
                        .filter(|other| requirement.counts(PARTIES[*other].0) && is_there(*other));
                    if there.count() < requirement.count() {
                        self.violations.push(format!("{} started at {at} without {text}", PARTIES[index].0));
                    }
                }
            }
        }
    }

    /// Nobody passes before all are there, and nobody passes one generation twice.
    fn judge_life(&mut self, index: usize, of_life: &[Visit], visits: &[Vec<(&Life, Vec<Visit>)>]) {
        let name = PARTIES[index].0;
        let mut last = 0;
        for (at, generation) in of_life.iter().filter_map(|visit| visit.passed) {
            if generation <= last {
                self.violations.push(format!("{name} passed {generation} after {last}"));
            }
            last = generation;
            for (other, lives) in visits.iter().enumerate() {
                // Who is counted has arrived, and has not gone on with an earlier generation.
                let waits = |(life, of_life): &(&Life, Vec<Visit>)| {
                    let is_it = |visit: &Visit| visit.passed.is_none_or(|(_, passed)| passed >= generation);
                    of_life.iter().any(|visit| is_it(visit) && life.counts(visit.at, at))
                };
                if !lives.iter().any(waits) {
                    let missing = PARTIES[other].0;
                    self.violations.push(format!("{name} passed {generation} at {at} without {missing}"));
                }
            }
        }
    }

    fn measure(&mut self, visits: &[Vec<(&Life, Vec<Visit>)>]) {
        let all = |generation: u64| -> Option<Vec<(u64, u64)>> {
            let of_party = |lives: &Vec<(&Life, Vec<Visit>)>| {
                let mut passed = lives.iter().flat_map(|(_, visits)| visits);
                passed.find_map(|visit| {
                    visit.passed.filter(|(_, of)| *of == generation).map(|(at, _)| (visit.at, at))
                })
            };
            visits.iter().map(of_party).collect()
        };
        let passes = visits.iter().flatten().flat_map(|(_, visits)| visits).filter_map(|visit| visit.passed);
        let highest = passes.map(|(_, generation)| generation).max().unwrap_or_default();
        for times in (1..=highest).filter_map(all) {
            let arrived = times.iter().map(|(arrived, _)| *arrived).max().unwrap_or_default();
            let first = times.iter().map(|(_, passed)| *passed).min().unwrap_or_default();
            let last = times.iter().map(|(_, passed)| *passed).max().unwrap_or_default();
            self.generations += 1;
            self.release.note(Duration::from_nanos(last.saturating_sub(arrived)));
            self.skew.note(Duration::from_nanos(last - first));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn life(events: &[Event]) -> Life {
        Life { events: events.to_vec(), killed: None }
    }

    /// All start and pass the first generation together; `change` makes it wrong.
    fn played(change: impl FnOnce(&mut Vec<Vec<Life>>)) -> Verdict {
        let mut parties: Vec<Vec<Life>> = (0..4)
            .map(|index| {
                vec![life(&[
                    Event::Started(10 + index),
                    Event::Arrived(20 + index),
                    Event::Passed(30 + index, 1),
                ])]
            })
            .collect();
        change(&mut parties);
        Verdict::of(&parties)
    }

    #[test]
    fn what_is_as_it_should_be_is_no_violation() {
        let verdict = played(|_| {});
        assert_eq!(verdict.violations, [""; 0]);
        assert_eq!((verdict.generations, verdict.skew.percentile(1.0)), (1, Duration::from_nanos(3)));
        assert_eq!(verdict.release.percentile(1.0), Duration::from_nanos(10));
    }

    #[test]
    fn each_sort_of_early_is_found() {
        let wrong: [fn(&mut Vec<Vec<Life>>); 4] = [
            |parties| parties[3][0].events[0] = Event::Started(5),
            |parties| parties[2][0].events[1] = Event::Arrived(40),
            |parties| parties[1][0].events[2..].clone_from_slice(&[Event::Passed(30, 0)]),
            |parties| parties[0][0].events.extend([Event::Arrived(50), Event::Passed(60, 1)]),
        ];
        for change in wrong {
            assert!(!played(change).violations.is_empty());
        }
    }

    #[test]
    fn what_a_killed_process_did_counts_until_its_loss_is_known() {
        let later = HEARSAY.as_nanos() as u64 + 100;
        let alone = |at| {
            move |parties: &mut Vec<Vec<Life>>| {
                parties[0][0].events.push(Event::Arrived(40));
                parties[0][0].killed = Some(50);
                for party in &mut parties[1..] {
                    party[0].events.extend([Event::Arrived(41), Event::Passed(at, 2)]);
                }
            }
        };
        assert_eq!(played(alone(60)).violations, [""; 0]);
        assert!(!played(alone(later)).violations.is_empty());
    }
}
