//! Flights of a task with built-in controllers.

use anyhow::anyhow;
use aviary::action::ActionType;
use aviary::control::trajectory::Trajectory;
use aviary::control::{ControllerKind, Reference};
use aviary::env::{DroneEnv, Info};
use aviary::rollout::{ControllerPolicy, PilotedPolicy, Rollout};
use aviary::tasks::{RaceTrack, hover_reward};
use nalgebra::Vector3;
use viewer::PilotedRollout;

use crate::failure::Failure;
use crate::options::FlightOptions;
use crate::output::decimals;
use crate::parse::Variation;

/// Episodes of a task with built-in controllers, as the command line sets them.
pub struct Pilot {
    /// Current episode.
    pub rollout: Rollout<Box<dyn DroneEnv>, PilotedPolicy<ControllerPolicy>>,
    options: FlightOptions,
    kind: ControllerKind,
    /// True if the drones follow the trajectory of --trajectory in place of the task's references.
    on_trajectory: bool,
    /// Track of --track.
    track: Option<RaceTrack>,
    seed: u64,
}

impl Pilot {
    /// Creates the first episode.
    pub fn new(options: &FlightOptions) -> Result<Self, Failure> {
        Self::varied(options, Variation::NONE)
    }

    /// Creates the first episode of episodes that vary.
    pub fn varied(options: &FlightOptions, variation: Variation) -> Result<Self, Failure> {
        let kind = options.controller()?;
        let trajectory = options.trajectory()?;
        let env = options.environment(trajectory.as_deref(), variation)?;
        let on_trajectory = trajectory.is_some();
        let policy = ControllerPolicy::new(kind, &env);
        let policy = if on_trajectory { policy.follow(trajectory) } else { policy };
        let policy = PilotedPolicy::new(policy).controller(kind);
        let track = env.task_options().track;
        let rollout = Rollout::start(env, policy, Some(options.seed)).map_err(Failure::work)?;
        Ok(Self { rollout, options: options.clone(), kind, on_trajectory, track, seed: options.seed })
    }

    fn num_drones(&self) -> usize {
        self.env().simulation().num_drones()
    }

    /// Returns the length of an episode, s.
    fn episode_seconds(&self) -> f64 {
        self.env().episode_steps() as f64 * self.env().simulation().control_period()
    }

    /// Flies and restarts the first episode; returns points of the planned and the flown paths (world frame, m).
    ///
    /// The restart has the same random numbers. Cameras that stand still keep these points in the frame.
    pub fn preview(&mut self) -> Result<Vec<Vector3<f64>>, Failure> {
        /// Time between points, s.
        const EVERY: f64 = 0.1;
        let mut points = self.env().extent();
        for drone in 0..self.num_drones() {
            if let Some(path) = self.path(drone) {
                let times = (0..=120).map(|i| path.duration() * f64::from(i) / 120.0);
                points.extend(times.map(|time| path.reference(time).position));
            }
        }
        let every = ((EVERY / self.env().simulation().control_period()).round() as u64).max(1);
        loop {
            // a failure occurs again in the flight itself, which reports it
            let goes_on = self.goes_on();
            let simulation = self.env().simulation();
            if !goes_on || simulation.control_steps().is_multiple_of(every) {
                points.extend(simulation.states().iter().map(|state| state.position));
            }
            if !goes_on {
                break;
            }
        }
        self.begin(Some(self.seed))?;
        Ok(points)
    }

    /// Returns the durations of the planned paths through the task, s.
    fn path_seconds(&self) -> impl Iterator<Item = f64> {
        let planned = if self.on_trajectory { 0 } else { self.num_drones() };
        (0..planned).filter_map(|drone| self.path(drone).map(Trajectory::duration))
    }

    /// Returns true if a planned path through the task takes longer than an episode.
    fn is_late(&self) -> bool {
        self.path_seconds().any(|seconds| seconds > self.episode_seconds())
    }

    /// Returns the first drone whose path or reference an obstacle blocks, with the position (world frame, m).
    fn obstruction(&mut self) -> Result<Option<(usize, Vector3<f64>)>, Failure> {
        if self.env().simulation().obstacles().is_empty() {
            return Ok(None);
        }
        let found = self.obstruction_of_path();
        if found.is_some() || (0..self.num_drones()).all(|drone| self.path(drone).is_some()) {
            return Ok(found);
        }
        // without a path, only the flight shows the references
        let found = loop {
            let drones = 0..self.num_drones();
            let mut places = drones.map(|drone| (drone, self.reference(drone).position));
            let found = places.find(|(drone, place)| self.is_blocked(*drone, place));
            if found.is_some() || !self.goes_on() {
                break found;
            }
        };
        self.begin(Some(self.seed))?;
        Ok(found)
    }

    /// Returns true if an obstacle is too close to a position (world frame, m) of a drone.
    fn is_blocked(&self, drone: usize, place: &Vector3<f64>) -> bool {
        let simulation = self.env().simulation();
        // with a margin for tracking errors
        let room = simulation.params(drone).collision_radius + 0.05;
        let obstacles = simulation.obstacles();
        // the path leads through the gates of a track, whose bars are the last obstacles
        let bars = |track: &RaceTrack| if track.solid { 4 * track.gates.len() } else { 0 };
        let own = self.track.as_ref().map_or(0, bars);
        obstacles[..obstacles.len() - own].iter().any(|obstacle| obstacle.distance(place) < room)
    }

    /// Returns the first obstruction of the drones' paths or, without a path, of the straight lines to the references.
    fn obstruction_of_path(&self) -> Option<(usize, Vector3<f64>)> {
        let simulation = self.env().simulation();
        (0..self.num_drones()).find_map(|drone| {
            let start = simulation.states()[drone].position;
            let is_blocked = |place: &Vector3<f64>| self.is_blocked(drone, place);
            let found = match self.path(drone) {
                Some(path) => {
                    // a trajectory may take much longer than an episode
                    let seconds = path.duration().min(self.episode_seconds());
                    let ticks = (seconds / 0.02).ceil() as u64;
                    (0..=ticks).map(|tick| path.reference(tick as f64 * 0.02).position).find(is_blocked)
                }
                None => {
                    let path = self.env().reference(drone).position - start;
                    (0..=100).map(|i| start + path * f64::from(i) / 100.0).find(is_blocked)
                }
            };
            found.map(|place| (drone, place))
        })
    }

    /// Refuses flights in which the built-in controllers cannot succeed; the error names options that work.
    ///
    /// These controllers do not avoid obstacles, and in a race each drone waits until its path is free.
    pub fn validate(&mut self, options: &FlightOptions) -> Result<(), Failure> {
        let task = self.env().name();
        if let Some((drone, place)) = self.obstruction()? {
            let which = if self.num_drones() > 1 { format!("drone {drone}") } else { "the drone".into() };
            let position = [place.x, place.y, place.z].map(|x| decimals(x, 2)).join(", ");
            const SEEDS: u64 = 30;
            let free = |seed: &u64| {
                let mut options = options.clone();
                options.seed = *seed;
                Self::new(&options).is_ok_and(|mut pilot| matches!(pilot.obstruction(), Ok(None)))
            };
            let other = (1..=SEEDS).map(|by| options.seed.wrapping_add(by)).find(free);
            let expected = match other {
                Some(seed) => format!("another layout: --seed {seed}"),
                None => "a larger `arena` in [obstacles]".into(),
            };
            return Err(Failure::input(anyhow!(
                "an obstacle blocks the path of {which} at ({position}) m, expected {expected}"
            )));
        }
        if self.num_drones() > 1 && self.is_late() {
            let success = self.fly_ahead()?.success;
            if !success {
                let (count, seconds) = (self.num_drones(), self.episode_seconds());
                let max = self.max_in_time(options, seconds);
                let seconds = aviary::number(seconds);
                return Err(Failure::input(anyhow!(
                    "--num-drones is {count}, expected at most {max} for {task} in {seconds} s, or a longer --duration"
                )));
            }
        }
        Ok(())
    }

    /// Returns the largest smaller number of drones whose paths through the task all end within the episode.
    fn max_in_time(&self, options: &FlightOptions, seconds: f64) -> usize {
        let in_time = |count: &usize| {
            let mut options = options.clone();
            options.num_drones = Some(*count);
            let mut env = options.environment(None, Variation::NONE).ok()?;
            env.reset(Some(options.seed)).ok()?;
            Some(env.plans().iter().flatten().all(|path| path.duration() <= seconds))
        };
        // each drone starts after the previous one, so that fewer drones have shorter paths
        let early = self.path_seconds().filter(|duration| *duration <= seconds).count();
        let highest = (2 * early + 24).min(self.num_drones() - 1);
        (1..=highest).rev().find(|count| in_time(count) == Some(true)).unwrap_or(1)
    }

    /// Flies the first episode, restarts it with the same random numbers, and returns its final info.
    fn fly_ahead(&mut self) -> Result<Info, Failure> {
        while self.goes_on() {}
        let info = self.env().info();
        self.begin(Some(self.seed))?;
        Ok(info)
    }

    /// Returns the kind of controller.
    pub fn kind(&self) -> ControllerKind {
        self.kind
    }

    /// Starts the next episode, with the random numbers that follow.
    pub fn restart(&mut self) -> Result<(), Failure> {
        self.begin(None)
    }

    /// Starts an episode, from a seed or with the random numbers that follow.
    fn begin(&mut self, seed: Option<u64>) -> Result<(), Failure> {
        self.rollout.restart(seed).map_err(Failure::work)
    }

    /// Returns the planned path of a drone, if it has one.
    pub fn path(&self, drone: usize) -> Option<&dyn Trajectory> {
        self.rollout.policy().inner().trajectory(drone)
    }

    /// Returns the current reference of a drone.
    pub fn reference(&self, drone: usize) -> Reference {
        self.rollout.policy().inner().reference(self.env(), drone)
    }

    /// Returns the reward of a drone for the last control step.
    ///
    /// With --trajectory, it is the reward of hover with the current point of the trajectory as the target.
    pub fn reward(&self, drone: usize) -> f64 {
        let (env, simulation) = (self.env(), self.env().simulation());
        match self.on_trajectory {
            true if simulation.control_steps() == 0 => 0.0,
            true => hover_reward(simulation.view(), drone, &self.reference(drone).position, env.drone_end(drone)),
            false => env.drone_reward(drone),
        }
    }

    /// Returns true if the drones follow the trajectory of --trajectory in place of the task's references.
    pub fn is_on_trajectory(&self) -> bool {
        self.on_trajectory
    }

    /// Returns true if a drone follows a path, through the task or along a trajectory.
    pub fn has_path(&self) -> bool {
        (0..self.num_drones()).any(|drone| self.path(drone).is_some())
    }

    /// Returns the largest distance of a drone from its reference, m.
    pub fn position_error(&self) -> f64 {
        let simulation = self.env().simulation();
        (0..simulation.num_drones())
            .map(|drone| simulation.distance(drone, &self.reference(drone).position))
            .fold(0.0, f64::max)
    }

    /// Makes a control step. Returns true if it succeeds and the episode continues.
    fn goes_on(&mut self) -> bool {
        self.rollout.step().is_ok() && !self.rollout.is_over()
    }

    /// Returns the environment.
    pub fn env(&self) -> &dyn DroneEnv {
        &**self.rollout.env()
    }
}

impl PilotedRollout for Pilot {
    type Policy = ControllerPolicy;

    fn rollout(&self) -> &Rollout<Box<dyn DroneEnv>, PilotedPolicy<ControllerPolicy>> {
        &self.rollout
    }

    fn rollout_mut(&mut self) -> &mut Rollout<Box<dyn DroneEnv>, PilotedPolicy<ControllerPolicy>> {
        &mut self.rollout
    }

    fn name(&self) -> String {
        self.kind.to_string()
    }

    fn reference(&self, drone: usize) -> Reference {
        Pilot::reference(self, drone)
    }

    fn kind(&self) -> Option<ControllerKind> {
        Some(self.kind)
    }

    fn set_kind(&mut self, kind: ControllerKind) -> Result<(), String> {
        if self.env().action_type() == ActionType::Vel {
            return Err(format!(
                "{} has its controllers in the environment: --controller sets them",
                self.env().name()
            ));
        }
        let policy = ControllerPolicy::new(kind, self.env());
        let trajectory = self.options.trajectory().map_err(|_| "the trajectory cannot be read again")?;
        let policy = if self.on_trajectory { policy.follow(trajectory) } else { policy };
        self.rollout.policy_mut().set_inner(policy);
        self.kind = kind;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use aviary::control::trajectory;
    use aviary::vision::{CameraPose, ImageSize, View};
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        options: FlightOptions,
    }

    fn options(line: &str) -> FlightOptions {
        let words = ["test"].into_iter().chain(line.split(' '));
        Line::try_parse_from(words.chain(["--engine", "hybrid"])).unwrap().options
    }

    const SIZE: ImageSize = ImageSize { width: 320, height: 240 };

    /// Asserts that every view that stands still has all drones of a flight in its frame.
    ///
    /// Returns the smallest size of a drone in a frame, as a fraction of the height of the frame.
    fn fraction_of_the_frame(line: &str) -> f64 {
        let mut pilot = Pilot::new(&options(line)).unwrap();
        let points = pilot.preview().unwrap();
        let params = pilot.env().simulation().params(0).clone();
        let obstacles = pilot.env().simulation().obstacles().to_vec();
        let poses = [View::Fixed, View::Front, View::Top]
            .map(|view| CameraPose::framing(view, &points, params.collision_radius, &obstacles, SIZE).unwrap());
        let mut share = f64::INFINITY;
        loop {
            for (drone, state) in pilot.env().simulation().states().iter().enumerate() {
                for pose in &poses {
                    for point in [state.position, pilot.reference(drone).position] {
                        let place = pose.project(&point, SIZE).unwrap();
                        assert!(place.iter().all(|x| x.abs() < 0.97), "{line}: {place:?}");
                    }
                    let distance = (state.position - pose.eye).norm();
                    share =
                        share.min(params.collision_radius / (distance * (CameraPose::FOVY / 2.0).to_radians().tan()));
                }
            }
            pilot.rollout.step().unwrap();
            if pilot.rollout.is_over() {
                return share;
            }
        }
    }

    #[test]
    fn views_that_stand_still_have_all_drones_in_the_frame() {
        // drones are large in the frame of a short flight
        for (line, min) in [("--task hover", 0.08), ("--task hover --obstacles forest", 0.03), ("--task track", 0.04)] {
            let share = fraction_of_the_frame(line);
            assert!(share > min, "{line}: {share}");
        }
        for task in aviary::tasks::NAMES {
            let share = fraction_of_the_frame(&format!("--task {task} --duration 8"));
            assert!(share > 0.005, "{task}: {share}");
        }
        for name in trajectory::NAMES {
            let share = fraction_of_the_frame(&format!("--task hover --trajectory {name}"));
            assert!(share > 0.01, "{name}: {share}");
        }
        let file = std::env::temp_dir().join(format!("lemniscate{}.toml", std::process::id()));
        std::fs::write(
            &file,
            "kind = \"lemniscate\"\nhalf_length = 6\nhalf_width = 3\npeak_speed = 2\ncentre = [0, 0, 1.5]\nramp = 2\n",
        )
        .unwrap();
        fraction_of_the_frame(&format!("--task hover --trajectory {}", file.display()));
        std::fs::remove_file(&file).unwrap();
    }

    #[test]
    fn a_preview_does_not_change_the_flight() {
        for line in ["--task hover --wind combined", "--task race --num-drones 2", "--task antipodal --num-drones 3"] {
            let fly = |ahead: bool| {
                let mut pilot = Pilot::new(&options(&format!("{line} --duration 4"))).unwrap();
                if ahead {
                    pilot.preview().unwrap();
                }
                pilot.rollout.finish(|_| {}).unwrap();
                pilot.env().simulation().states().to_vec()
            };
            assert_eq!(fly(false), fly(true), "{line}");
        }
    }

    /// Outcome of a flight with built-in controllers.
    #[derive(Debug, PartialEq)]
    enum Outcome {
        /// Refused, with this error.
        Refused(String),
        Success,
        /// Flown without success.
        Failure(String),
    }

    fn outcome(line: &str) -> Outcome {
        let options = options(line);
        let ready = Pilot::new(&options).and_then(|mut pilot| pilot.validate(&options).map(|()| pilot));
        let mut pilot = match ready {
            Ok(pilot) => pilot,
            Err(Failure::Input(error)) => return Outcome::Refused(error.to_string()),
            Err(Failure::Work(error)) => return Outcome::Failure(error.to_string()),
        };
        pilot.rollout.finish(|_| {}).unwrap();
        let info = pilot.env().info();
        if info.success { Outcome::Success } else { Outcome::Failure(format!("{:?} {:.2} s", info.end, info.time)) }
    }

    #[test]
    fn races_with_too_many_drones_are_refused_with_a_number_that_works() {
        for line in ["--task race --num-drones 6", "--task race --num-drones 8", "--task fly_through --num-drones 7"] {
            assert_eq!(outcome(line), Outcome::Success, "{line}");
        }
        let Outcome::Refused(error) = outcome("--task fly_through --num-drones 14") else {
            panic!("14 drones in 20 s")
        };
        let max = error.split("expected at most ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
        let max: usize = max.parse().unwrap();
        assert!(max >= 7, "{error}");
        assert_eq!(outcome(&format!("--task fly_through --num-drones {max}")), Outcome::Success, "{error}");
    }

    #[test]
    fn obstacles_on_the_path_are_refused_with_a_seed_that_works() {
        assert_eq!(outcome("--task hover --obstacles indoor"), Outcome::Success);
        // every layout of the room has its walls between the gates of the race
        let Outcome::Refused(error) = outcome("--task race --obstacles indoor") else { panic!("through a wall") };
        assert!(error.contains("an obstacle blocks the path of the drone") && error.contains("`arena`"), "{error}");
        let refused =
            (0..20).find_map(|seed| match outcome(&format!("--task fly_through --obstacles random --seed {seed}")) {
                Outcome::Refused(error) => Some(error),
                outcome => {
                    assert_eq!(outcome, Outcome::Success, "seed {seed}");
                    None
                }
            });
        let error = refused.expect("an obstacle on the path of one of 20 flights");
        let seed = error.split("--seed ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
        assert_eq!(
            outcome(&format!("--task fly_through --obstacles random --seed {seed}")),
            Outcome::Success,
            "{error}"
        );
    }

    #[test]
    #[ignore = "flies every task with 1 to 20 and 40 drones: minutes; prints a table with --nocapture"]
    fn every_task_with_many_drones_succeeds_or_is_refused() {
        let lines = aviary::tasks::NAMES.iter().flat_map(|task| {
            let counts = (1..=20).chain([40]);
            counts.flat_map(move |count| {
                (0..3).map(move |seed| format!("--task {task} --num-drones {count} --seed {seed}"))
            })
        });
        let failures = failures(lines);
        assert!(failures.is_empty(), "{failures:#?}");
    }

    #[test]
    #[ignore = "flies every task among obstacles of every kind: minutes; prints a table with --nocapture"]
    fn every_task_among_obstacles_succeeds_or_is_refused() {
        let lines = aviary::tasks::NAMES.iter().flat_map(|task| {
            let kinds = ["forest", "urban", "indoor", "random", "gates"].into_iter();
            kinds
                .flat_map(move |kind| (0..6).map(move |seed| format!("--task {task} --obstacles {kind} --seed {seed}")))
        });
        let failures = failures(lines);
        assert!(failures.is_empty(), "{failures:#?}");
    }

    /// Prints a line for each flight and returns the flights without success that were not refused.
    #[allow(clippy::print_stdout)]
    fn failures(lines: impl Iterator<Item = String>) -> Vec<String> {
        let flights = lines.map(|line| {
            let begin = std::time::Instant::now();
            let outcome = outcome(&line);
            let text = format!("{line}: {outcome:?}");
            println!("{text} ({:.2} s)", begin.elapsed().as_secs_f64());
            (text, matches!(outcome, Outcome::Failure(_)))
        });
        flights.filter_map(|(text, failed)| failed.then_some(text)).collect()
    }
}
