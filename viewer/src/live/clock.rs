//! Real time.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Times of control steps.
#[derive(Debug, Default)]
pub(super) struct Clock {
    /// Time at which the last step was due.
    last: Option<Instant>,
    /// Times of the steps of the last second.
    recent: VecDeque<Instant>,
}

/// Delay after which the flight does not catch up any more.
const GIVE_UP: Duration = Duration::from_millis(200);

impl Clock {
    /// Forgets the last step: the next one is due at once.
    pub fn restart(&mut self) {
        self.last = None;
        self.recent.clear();
    }

    /// Returns the time of the next step, `seconds` after the last one.
    pub fn due(&self, now: Instant, seconds: f64) -> Instant {
        match self.last {
            Some(last) => (last + Duration::from_secs_f64(seconds)).max(now.checked_sub(GIVE_UP).unwrap_or(now)),
            None => now,
        }
    }

    /// Counts a step that was due at a time. Steps follow the time at which they were due, so that delays do not add
    /// up.
    pub fn count(&mut self, now: Instant, due: Instant) {
        self.last = Some(due);
        self.recent.push_back(now);
        while self.recent.len() > 2 && self.recent.front().is_some_and(|&first| now - first > Duration::from_secs(1)) {
            self.recent.pop_front();
        }
    }

    /// Returns the steps per second, averaged over the last second.
    pub fn rate(&self) -> f64 {
        match (self.recent.front(), self.recent.back()) {
            (Some(&first), Some(&last)) if last > first => {
                (self.recent.len() - 1) as f64 / (last - first).as_secs_f64()
            }
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MILLISECOND: Duration = Duration::from_millis(1);

    /// Steps that come late do not make the following ones late.
    #[test]
    fn delays_do_not_add_up() {
        let (mut clock, start) = (Clock::default(), Instant::now());
        for index in 0..100_u32 {
            let due = clock.due(start, 0.004);
            let late = MILLISECOND * (7 * index % 11);
            clock.count(due + late, due);
        }
        assert_eq!(clock.last, Some(start + 99 * 4 * MILLISECOND));
        assert!((clock.rate() - 250.0).abs() < 10.0, "{}", clock.rate());
    }

    #[test]
    fn long_interruptions_are_given_up() {
        let (mut clock, start) = (Clock::default(), Instant::now());
        clock.count(start, clock.due(start, 0.01));
        let later = start + Duration::from_secs(3600);
        let mut caught_up = 0;
        while clock.due(later, 0.01) <= later {
            clock.count(later, clock.due(later, 0.01));
            caught_up += 1;
        }
        assert_eq!(caught_up, 21);
        clock.restart();
        assert_eq!(clock.due(later, 0.01), later);
    }
}
