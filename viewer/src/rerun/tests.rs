//! Recordings are read back with Rerun's own reader.

use aviary::control::ControllerKind;
use aviary::env::{DroneEnv, EnvConfig};
use aviary::rollout::{ControllerPolicy, Rollout};
use aviary::tasks::make;
use rerun::log::{Chunk, LogMsg};
use rerun::sink::MemorySinkStorage;

use super::*;

type Flown = Rollout<Box<dyn DroneEnv>, ControllerPolicy>;

fn start(task: &str, config: EnvConfig) -> Flown {
    let env: Box<dyn DroneEnv> = make(task, config).unwrap();
    let policy = ControllerPolicy::new(ControllerKind::Dsl, &env);
    Rollout::start(env, policy, Some(5)).unwrap()
}

fn in_memory(flown: &Flown, with_images: bool) -> (RerunLog, MemorySinkStorage) {
    let builder = RecordingStreamBuilder::new("test").default_enabled(true);
    let (stream, storage) = builder.memory().unwrap();
    let source = Source::Env(&**flown.env());
    let target = RerunTarget::File("memory".into());
    let log = RerunLog::on(stream, target, source, |drone| source.reference(drone), with_images).unwrap();
    (log, storage)
}

fn chunks(storage: &MemorySinkStorage) -> Vec<Chunk> {
    let chunk = |message| match message {
        LogMsg::ArrowMsg(_, message) => Some(Chunk::from_arrow_msg(&message).unwrap()),
        _ => None,
    };
    storage.take().into_iter().filter_map(chunk).collect()
}

/// Returns the control steps and the values of a component of three numbers.
fn triples(chunks: &[Chunk], path: &str, component: rerun::ComponentDescriptor) -> Vec<(i64, Vec<[f32; 3]>)> {
    let mut rows = Vec::new();
    for chunk in chunks.iter().filter(|chunk| chunk.entity_path() == &path.into()) {
        let steps = chunk.iter_component_indices("step".into(), component.component);
        let values = chunk.iter_slices::<[f32; 3]>(component.component);
        rows.extend(steps.zip(values).map(|((step, _), values)| (step.as_i64(), values.to_vec())));
    }
    rows.sort_by_key(|row| row.0);
    rows
}

/// Returns the images of the first drone's camera, in the order of time.
fn images(chunks: &[Chunk]) -> Vec<Vec<u8>> {
    let component = EncodedImage::descriptor_blob().component;
    let of_camera = chunks.iter().filter(|chunk| chunk.entity_path() == &"world/drone0/camera".into());
    let mut images: Vec<_> = of_camera
        .flat_map(|chunk| {
            let steps = chunk.iter_component_indices("step".into(), component);
            steps.zip(chunk.iter_slices::<&[u8]>(component)).map(|((step, _), rows)| (step, rows[0].to_vec()))
        })
        .collect();
    images.sort_by_key(|(step, _)| *step);
    images.into_iter().map(|(_, png)| png).collect()
}

#[test]
fn poses_times_and_series_are_those_of_the_flight() {
    let mut flown = start("multi_hover", EnvConfig::default().episode_seconds(1.0));
    let (mut log, storage) = in_memory(&flown, false);
    let mut states = vec![flown.env().simulation().states().to_vec()];
    while !flown.is_over() {
        flown.step().unwrap();
        log.note(Source::Env(&**flown.env())).unwrap();
        states.push(flown.env().simulation().states().to_vec());
    }
    log.finish().unwrap();
    let chunks = chunks(&storage);
    assert!(states.len() > 40 && states[0].len() > 1);
    for drone in 0..states[0].len() {
        let path = format!("world/drone{drone}");
        let poses = triples(&chunks, &path, Transform3D::descriptor_translation());
        assert_eq!(poses.len(), states.len());
        for (step, ((at, position), state)) in poses.iter().zip(states.iter().map(|state| &state[drone])).enumerate() {
            assert_eq!((*at, position[..].to_vec()), (step as i64, vec![point(&state.position)]));
        }
        let component = Transform3D::descriptor_quaternion().component;
        let of_drone = chunks.iter().filter(|chunk| chunk.entity_path() == &path.as_str().into());
        let attitudes: usize = of_drone.map(|chunk| chunk.iter_slices::<[f32; 4]>(component).count()).sum();
        assert_eq!(attitudes, states.len());
        let velocity = rerun::EntityPath::from(format!("plots/drone{drone}/velocity"));
        let component = Scalars::descriptor_scalars().component;
        let of_series = chunks.iter().filter(|chunk| *chunk.entity_path() == velocity);
        let mut last: Vec<_> = of_series
            .flat_map(|chunk| {
                let steps = chunk.iter_component_indices("step".into(), component);
                steps.zip(chunk.iter_slices::<f64>(component).map(<[f64]>::to_vec)).map(|((step, _), row)| (step, row))
            })
            .collect();
        last.sort_by_key(|(step, _)| *step);
        let expected: Vec<_> = states.iter().map(|state| state[drone].velocity.as_slice().to_vec()).collect();
        assert_eq!(last.into_iter().map(|(_, row)| row).collect::<Vec<_>>(), expected);
    }
}

#[test]
fn every_term_of_the_reward_is_a_series_with_its_name() {
    let mut flown = start("multi_hover", EnvConfig::default().episode_seconds(0.5));
    let (mut log, storage) = in_memory(&flown, false);
    let mut terms = Vec::new();
    while !flown.is_over() {
        flown.step().unwrap();
        log.note(Source::Env(&**flown.env())).unwrap();
        terms.push([0, 1].map(|drone| flown.env().reward_terms(drone)));
    }
    log.finish().unwrap();
    let chunks = chunks(&storage);
    let component = Scalars::descriptor_scalars().component;
    for drone in 0..2 {
        for (index, (name, _)) in terms[0][drone].iter().enumerate() {
            let path = rerun::EntityPath::from(format!("plots/drone{drone}/reward/{name}"));
            let of_term = || chunks.iter().filter(|chunk| *chunk.entity_path() == path);
            let mut rows: Vec<_> = of_term()
                .flat_map(|chunk| {
                    let steps = chunk.iter_component_indices("step".into(), component);
                    steps.zip(chunk.iter_slices::<f64>(component).map(|row| row[0])).map(|((step, _), x)| (step, x))
                })
                .collect();
            rows.sort_by_key(|(step, _)| *step);
            let expected: Vec<_> = terms.iter().map(|terms| terms[drone][index].1).collect();
            assert_eq!(rows.iter().map(|(_, x)| *x).collect::<Vec<_>>(), expected, "{name}");
            assert_eq!(rows[0].0.as_i64(), 1);
            let names = SeriesLines::descriptor_names().component;
            let named: Vec<_> = of_term().flat_map(|chunk| chunk.iter_slices::<String>(names)).flatten().collect();
            assert_eq!(named.iter().map(|name| name.as_str()).collect::<Vec<_>>(), [*name]);
        }
    }
}

#[test]
fn attitudes_turn_the_body_as_in_the_simulation() {
    let rotation = attitude_from_rpy(Vector3::new(0.3, -0.7, 2.0));
    let [x, y, z, w] = quaternion(&rotation).0.map(f64::from);
    let back = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z));
    assert!((back * Vector3::x() - rotation * Vector3::x()).norm() < 1e-6);
}

#[test]
fn obstacles_that_move_are_recorded_again() {
    let boxes = |x: f64| {
        let mut body = Obstacle::new(Shape::Box { half_size: [0.1, 0.2, 0.3] }, Vector3::new(x, 2.0, 0.3));
        body.rpy = Vector3::new(0.0, 0.0, 0.5);
        body
    };
    let pole = Obstacle::new(Shape::Capsule { radius: 0.05, half_height: 0.4 }, Vector3::new(-2.0, 1.0, 1.0));
    let config = EnvConfig::default().obstacles([boxes(2.0), pole]);
    let mut flown = start("hover", config);
    let (mut log, storage) = in_memory(&flown, false);
    flown.step().unwrap();
    log.note(Source::Env(&**flown.env())).unwrap();
    flown.env_mut().set_obstacles(&[boxes(3.0), pole]).unwrap();
    flown.step().unwrap();
    log.note(Source::Env(&**flown.env())).unwrap();
    log.finish().unwrap();
    let chunks = chunks(&storage);
    let centres = triples(&chunks, "world/obstacles/boxes", Boxes3D::descriptor_centers());
    assert_eq!(centres, [(0, vec![[2.0, 2.0, 0.3]]), (2, vec![[3.0, 2.0, 0.3]])]);
    // the lower end of an upright capsule
    let ends = triples(&chunks, "world/obstacles/capsules", Capsules3D::descriptor_translations());
    assert_eq!(ends[0], (0, vec![[-2.0, 1.0, 0.6]]));
}

#[test]
fn cameras_see_obstacles_that_moved_between_two_images() {
    let wall = |x: f64| Obstacle::new(Shape::Box { half_size: [0.05, 3.0, 3.0] }, Vector3::new(x, 0.0, 3.0));
    let last_image = |from: f64, to: f64| {
        let mut flown = start("hover", EnvConfig::default().obstacles([wall(from)]));
        let (mut log, storage) = in_memory(&flown, true);
        for step in 0..12 {
            if step == 2 {
                flown.env_mut().set_obstacles(&[wall(to)]).unwrap();
            }
            flown.step().unwrap();
            log.note(Source::Env(&**flown.env())).unwrap();
        }
        log.finish().unwrap();
        images(&chunks(&storage)).pop().unwrap()
    };
    assert_eq!(last_image(2.0, 4.0), last_image(4.0, 4.0));
    assert_ne!(last_image(2.0, 4.0), last_image(2.0, 2.0));
}

#[test]
fn cameras_have_images_ten_times_per_second() {
    let mut flown = start("hover", EnvConfig::default().episode_seconds(1.0));
    let (mut log, storage) = in_memory(&flown, true);
    while !flown.is_over() {
        flown.step().unwrap();
        log.note(Source::Env(&**flown.env())).unwrap();
    }
    log.finish().unwrap();
    let images = images(&chunks(&storage));
    assert!((10..=11).contains(&images.len()), "{} images", images.len());
    assert!(images.iter().all(|png| png.starts_with(b"\x89PNG")));
}

#[test]
fn errors_are_one_line_and_name_the_target() {
    let flown = start("hover", EnvConfig::default());
    let source = Source::Env(&**flown.env());
    for target in ["no/such/directory/x.rrd", "rerun+http://127.0.0.1:1/proxy", "https://example.org", "x://"] {
        let error = RerunLog::begin(&target.into(), source, false).unwrap_err().to_string();
        assert!(error.starts_with(&format!("{target}: ")) && !error.contains('\n'), "{error}");
    }
}
