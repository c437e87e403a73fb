use mujoco_rs::{BodyId, ConstraintOptions, GeomId, Model};

use super::contact_solver::Settings;
use crate::world::World;

/// Contact model of the floor and the collision cylinders, with the numbers of a compiled MuJoCo model.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FloorModel {
    pub(super) contact: FloorContact,
    /// Cylinder of each drone.
    pub(super) cylinders: Vec<Cylinder>,
}

/// Collision cylinder, centred on the body, with its axis along body z.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cylinder {
    /// Radius, m.
    pub radius: f64,
    /// Half of the height, m.
    pub half_height: f64,
}

/// Constants of the contacts between a drone and the floor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FloorContact {
    pub solver: Settings,
    /// Acceleration per depth, 1/s²; MuJoCo multiplies it by the impedance.
    pub stiffness: f64,
    /// Deceleration per speed, 1/s.
    pub damping: f64,
    pub impedance: Impedance,
}

/// Share of the reference acceleration that a contact attains, as a function of its depth (`solimp`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Impedance {
    /// Impedance at the surface.
    pub(super) min: f64,
    /// Impedance from the end of the transition on.
    pub(super) max: f64,
    /// Reciprocal of the depth of the transition, 1/m.
    pub(super) inverse_width: f64,
    /// Share of the transition at which it changes from one parabola to the other.
    pub(super) midpoint: f64,
    /// Coefficients of the parabolas: reciprocals of `midpoint` and of its difference from one.
    pub(super) parabolas: [f64; 2],
}

impl Impedance {
    /// Creates the impedance of `solimp`: impedances at the surface and from the depth `width` (m) on, and midpoint.
    fn new(min: f64, max: f64, width: f64, midpoint: f64) -> Self {
        Self { min, max, inverse_width: 1.0 / width, midpoint, parabolas: [1.0 / midpoint, 1.0 / (1.0 - midpoint)] }
    }

    /// Returns the impedance at a depth (m), which is positive.
    #[inline(always)]
    pub(super) fn at(&self, depth: f64) -> f64 {
        let (x, [before, after]) = (depth * self.inverse_width, self.parabolas);
        if x >= 1.0 {
            return self.max;
        }
        let y = if x <= self.midpoint { x * x * before } else { 1.0 - (1.0 - x) * (1.0 - x) * after };
        self.min + y * (self.max - self.min)
    }
}

/// Limits of MuJoCo for the numbers of `solimp`.
const IMPEDANCES: std::ops::RangeInclusive<f64> = 0.0001..=0.9999;

impl FloorModel {
    /// Reads the contact model of a compiled scene. Returns `None` if the scene has a setting that
    /// the [`FloorKernel`](super::floor::FloorKernel) does not implement.
    pub(crate) fn read(model: &Model, world: &World) -> Option<Self> {
        let floor: GeomId = model.find("floor").ok()?;
        let mut shared = None;
        let mut cylinders = Vec::with_capacity(world.drones.len());
        for index in 0..world.drones.len() {
            let body: BodyId = model.find(&World::drone_name(index)).ok()?;
            let geom: GeomId = model.find(&World::drone_name(index)).ok()?;
            let contact = FloorContact::read(model, floor, geom)?;
            if shared.is_some_and(|shared| shared != contact) || !is_plain_body(model, body, geom) {
                return None;
            }
            shared = Some(contact);
            let size = &model.geom_size()[3 * geom.index()..];
            cylinders.push(Cylinder { radius: size[0], half_height: size[1] });
        }
        Some(Self { contact: shared?, cylinders })
    }
}

/// Returns true if a free body has one geom, a cylinder at its centre of mass, and no springs, dampers or armature.
fn is_plain_body(model: &Model, body: BodyId, geom: GeomId) -> bool {
    const CYLINDER: i32 = 5;
    let (body, geom) = (body.index(), geom.index());
    let is_zero = |numbers: &[f64]| numbers.iter().all(|&x| x == 0.0);
    model.body_geomnum()[body] == 1
        && model.geom_type()[geom] == CYLINDER
        && is_zero(&model.geom_pos()[3 * geom..][..3])
        && is_zero(&model.body_ipos()[3 * body..][..3])
        && model.geom_quat()[4 * geom..][..4] == [1.0, 0.0, 0.0, 0.0]
        && model.body_iquat()[4 * body..][..4] == [1.0, 0.0, 0.0, 0.0]
        && is_zero(model.jnt_stiffness())
        && is_zero(model.dof_damping())
        && is_zero(model.dof_frictionloss())
        && is_zero(model.dof_armature())
}

impl FloorContact {
    /// Reads the contact of two geoms, a plane at the origin and a body.
    fn read(model: &Model, floor: GeomId, geom: GeomId) -> Option<Self> {
        const PLANE: i32 = 0;
        let [floor, geom] = [floor.index(), geom.index()];
        let options: ConstraintOptions = model.constraint_options();
        // every number here is that of the defaults of MJCF
        let plain = options.newton
            && options.pyramidal
            && options.noslip_iterations == 0
            && options.impratio == 1.0
            && (options.disabled, options.enabled, options.collision) == (0, 0, 0)
            && model.npair() == 0
            && model.nexclude() == 0
            && model.neq() == 0
            && model.ntendon() == 0
            && model.geom_type()[floor] == PLANE
            && model.geom_bodyid()[floor] == 0
            && model.geom_pos()[3 * floor..][..3] == [0.0; 3]
            && model.geom_quat()[4 * floor..][..4] == [1.0, 0.0, 0.0, 0.0]
            && [floor, geom].iter().all(|&i| {
                model.geom_condim()[i] == 3
                    && model.geom_contype()[i] == 1
                    && model.geom_conaffinity()[i] == 1
                    && model.geom_priority()[i] == 0
                    && model.geom_margin()[i] == 0.0
                    && model.geom_gap()[i] == 0.0
                    && model.geom_fluid()[i * (model.geom_fluid().len() / model.ngeom())] == 0.0
            });
        if !plain {
            return None;
        }
        let equal =
            |numbers: &[f64], width: usize| numbers[width * floor..][..width] == numbers[width * geom..][..width];
        if !(equal(model.geom_friction(), 3)
            && equal(model.geom_solmix(), 1)
            && equal(model.geom_solref(), 2)
            && equal(model.geom_solimp(), 5))
        {
            return None;
        }
        let [time, damping]: [f64; 2] = *model.geom_solref()[2 * geom..].first_chunk()?;
        let [min, max, width, midpoint, power]: [f64; 5] = *model.geom_solimp()[5 * geom..].first_chunk()?;
        let friction = model.geom_friction()[3 * geom];
        let restated = time > 0.0
            && damping > 0.0
            && min < max
            && [min, max, midpoint].iter().all(|x| IMPEDANCES.contains(x))
            && width > 1e-10
            && power == 2.0
            && friction > 1e-4;
        if !restated {
            return None;
        }
        // MuJoCo's limit of the time constant, which keeps the integrator stable
        let time = time.max(2.0 * model.timestep());
        Some(Self {
            solver: Settings {
                friction,
                tolerance: options.tolerance,
                scale: options.mean_inertia * model.nv().max(1) as f64,
                iterations: options.iterations,
            },
            stiffness: 1.0 / (max * max * time * time * damping * damping),
            damping: 2.0 / (max * time),
            impedance: Impedance::new(min, max, width, midpoint),
        })
    }

    /// Returns the weight of the edges of a contact with this impedance and a body of this mass, kg; `1 / R` in MuJoCo.
    #[inline(always)]
    pub(super) fn weight(&self, impedance: f64, inverse_mass: f64) -> f64 {
        impedance / ((1.0 - impedance) * self.diagonal(inverse_mass))
    }

    /// Returns the inverse of the weight at an impedance of one half, 1/kg.
    #[inline(always)]
    pub(super) fn diagonal(&self, inverse_mass: f64) -> f64 {
        let friction = self.solver.friction * self.solver.friction;
        // MuJoCo's estimate of the inverse inertia of an edge, and the scale that matches an elliptic cone
        (1.0 + friction) * inverse_mass * (2.0 * friction)
    }
}
