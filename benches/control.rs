//! Time of one call of each controller: `cargo bench --bench control`.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use mujoco_drones_gym::control::{ControllerKind, trajectory};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::state::attitude_from_rpy;
use nalgebra::Vector3;

fn controllers(c: &mut Criterion) {
    let params = DroneModel::Cf2x.params();
    let path = trajectory::named("lemniscate").expect("a trajectory");
    let state = DroneState {
        position: Vector3::new(0.1, -0.2, 1.1),
        attitude: attitude_from_rpy(Vector3::new(0.2, -0.1, 0.4)),
        velocity: Vector3::new(0.5, 0.1, -0.2),
        angular_velocity: Vector3::new(0.3, -0.5, 0.1),
    };
    let reference = path.reference(1.3);
    for kind in ControllerKind::ALL {
        let mut control = kind.build(&params);
        c.bench_function(kind.name(), |b| {
            b.iter(|| control.control(1.0 / 48.0, black_box(&state), black_box(&reference)).rpm);
        });
    }
    c.bench_function("reference of a lemniscate", |b| b.iter(|| path.reference(black_box(1.3))));
}

criterion_group!(benches, controllers);
criterion_main!(benches);
