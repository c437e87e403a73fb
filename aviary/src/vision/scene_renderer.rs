//! Renderer of a world, with its scene and cameras.

use mujoco_rs::{
    BodyId, Camera, CameraId, Data, Error, GeomId, ImageSize, JointId, LightId, Model, Quality, Renderer,
    RendererContext, Scene, VisualEffects,
};
use nalgebra::Vector3;

use super::{CameraPose, View};
use crate::engine::{BuildError, place_geom};
use crate::state::{DroneState, wxyz};
use crate::world::{Marker, Obstacle, SceneError, World};

/// Renderer of a world.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::simulation::Simulation;
/// use aviary::vision::{CAMERA_SIZE, SceneRenderer, intrinsics};
///
/// # if mujoco_rs::gl_info().is_err() { return Ok(()); } // no OpenGL
/// let simulation = Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 1.0]]).build()?;
/// let mut renderer = SceneRenderer::for_observations(simulation.world())?;
/// renderer.update(simulation.states())?;
/// let mut depth = vec![0.0; CAMERA_SIZE.pixels()];
/// renderer.onboard_depth(0, CAMERA_SIZE, &mut depth)?;
/// // the middle of the bottom row sees the floor, 1 m below the camera
/// let [_, focal, _, middle] = intrinsics(CAMERA_SIZE);
/// let floor = focal / (47.5 - middle);
/// assert!((f64::from(depth[depth.len() - 1]) - floor).abs() < 1e-3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct SceneRenderer {
    // dropped before `data`, whose model it draws
    pub(super) renderer: Renderer,
    pub(super) scene: Scene,
    pub(super) data: Data,
    joints: Vec<usize>,
    pub(super) bodies: Vec<BodyId>,
    cameras: Vec<CameraId>,
    /// Point that the static views look at and the distance around it, if the caller has set them.
    stage: Option<(Vector3<f64>, f64)>,
    /// Points that the static views keep in the frame otherwise.
    kept: Vec<Vector3<f64>>,
    obstacles: Vec<Obstacle>,
    /// View, size and pose of the last image. The `track` view uses only the viewing direction of the pose.
    posed: Option<(View, ImageSize, CameraPose)>,
    /// Positions of the drones, world frame, m.
    places: Vec<Vector3<f64>>,
    /// Distance at which the largest drone fills a good part of the image, m.
    size: f64,
    sun: usize,
    floor: GeomId,
    /// Bodies of the markers, such as gates, which the static views also keep in the frame.
    markers: Vec<Obstacle>,
    /// Bounding box of the obstacles and markers; `None` without any.
    standing: Option<[Vector3<f64>; 2]>,
    stale: bool,
}

/// Half side of the largest square that the shadow map covers, m. Its texels are 12 mm wide at this size.
const SHADOW_REACH: f64 = 12.0;
/// Distance of the sun from the centre of the square, m. All bodies that cast shadows are between the sun and the
/// floor.
const SUN_DISTANCE: f64 = 40.0;

impl SceneRenderer {
    /// Creates a renderer for onboard cameras: one sample per pixel, no shadows, no reflections, black sky.
    ///
    /// # Errors
    /// [`BuildError`] if the scene does not compile or OpenGL is not available.
    pub fn for_observations(world: &World) -> Result<Self, BuildError> {
        Self::new(world, Quality::FAST, VisualEffects::default())
    }

    /// Creates a renderer for people: shadows, reflections, sky and several samples per pixel. Propellers are
    /// slightly transparent, so that depth images do not contain them.
    ///
    /// # Errors
    /// Returns the errors of [`for_observations`](Self::for_observations).
    pub fn for_people(world: &World) -> Result<Self, BuildError> {
        Self::new(world, Quality::PRETTY, VisualEffects::pretty())
    }

    /// Creates a renderer with any quality and effects.
    ///
    /// # Errors
    /// Returns the errors of [`for_observations`](Self::for_observations).
    pub fn new(world: &World, quality: Quality, effects: VisualEffects) -> Result<Self, BuildError> {
        if world.drones.is_empty() {
            let what = "the number of drones to draw".into();
            return Err(SceneError::Value { what, got: 0.0, expected: "at least 1" }.into());
        }
        let (xml, assets) = world.to_visible_mjcf()?;
        let mut model = Model::from_xml_with_assets(&xml, &assets)?;
        if effects.shadows {
            thin_blades(&mut model, world)?;
        }
        for (index, obstacle) in world.obstacles.iter().enumerate() {
            let geom: GeomId = model.find(&World::obstacle_name(index))?;
            place_geom(&mut model.patch(), geom, obstacle)?;
        }
        for marker in &world.markers {
            let geom: GeomId = model.find(&marker.name)?;
            place_geom(&mut model.patch(), geom, &marker.body)?;
        }
        let data = Data::new(model)?;
        let model = data.shared_model();
        let mut scene = Scene::new(model.clone(), 20_000)?;
        scene.set_effects(effects);
        let floor: GeomId = model.find("floor")?;
        scene.set_ground(Some(floor));
        let (mut joints, mut bodies, mut cameras) = (Vec::new(), Vec::new(), Vec::new());
        for index in 0..world.drones.len() {
            let joint: JointId = model.find(&World::drone_name(index))?;
            let body: BodyId = model.find(&World::drone_name(index))?;
            joints
                .push(usize::try_from(model.jnt_qposadr()[joint.index()]).expect("an address of a joint that exists"));
            bodies.push(body);
            cameras.push(model.find(&World::camera_name(index))?);
        }
        let sun: LightId = model.find("sun")?;
        let sun = sun.index();
        let renderer = Renderer::new(model, quality)?;
        Ok(Self {
            renderer,
            scene,
            data,
            joints,
            bodies,
            cameras,
            stage: None,
            kept: world.drones.iter().map(|drone| drone.position).collect(),
            obstacles: world.obstacles.clone(),
            posed: None,
            places: world.drones.iter().map(|drone| drone.position).collect(),
            size: world.drones.iter().map(|drone| 6.0 * drone.params.arm_length + 0.1).fold(0.0, f64::max),
            sun,
            floor,
            markers: world.markers.iter().map(|marker| marker.body).collect(),
            standing: bounds(world.obstacles.iter().chain(world.markers.iter().map(|marker| &marker.body))),
            stale: true,
        })
    }

    /// Returns the OpenGL context of the renderer, to keep it current during several images.
    pub fn context(&self) -> RendererContext {
        self.renderer.context()
    }

    /// Updates the scene to the states of the drones and removes all [added](Self::add) shapes.
    ///
    /// # Errors
    /// [`Error::Buffer`] for a wrong number of states, [`Error::Value`] for a state that is not finite, and the
    /// errors of MuJoCo.
    pub fn update(&mut self, states: &[DroneState]) -> Result<(), Error> {
        self.stale = true;
        if states.len() != self.joints.len() {
            return Err(Error::Buffer { what: "states", got: states.len(), expected: self.joints.len() });
        }
        if states.iter().any(|state| !state.is_finite()) {
            return Err(Error::Value { what: "a drone's state", got: f64::NAN, expected: "finite numbers" });
        }
        for (&address, state) in self.joints.iter().zip(states) {
            let position = &mut self.data.qpos_mut()[address..][..7];
            position[..3].copy_from_slice(state.position.as_slice());
            position[3..].copy_from_slice(&wxyz(&state.attitude));
        }
        self.data.kinematics()?;
        self.places.clear();
        self.places.extend(states.iter().map(|state| state.position));
        let centre = self.places.iter().sum::<Vector3<f64>>() / self.places.len().max(1) as f64;
        // rays need the floor at the drones; the scene draws it below the camera
        let [x, y] = [centre.x, centre.y].map(|at| (at / Scene::GRID).round() * Scene::GRID);
        self.data.set_geom_xpos(self.floor, [x, y, 0.0])?;
        self.cast_shadows(&centre)?;
        let camera = Camera::Fixed(self.cameras[0]);
        self.scene.update(&mut self.data, &camera)?;
        self.stale = false;
        Ok(())
    }

    /// Places the sun and its shadow map so that they cover the drones and all bodies around them. If the texels
    /// would become too wide, they cover only the surroundings of the drones.
    fn cast_shadows(&mut self, centre: &Vector3<f64>) -> Result<(), Error> {
        // a shadow lies on the ray of light through its body, so that a map that covers the body covers the shadow
        let around = Vector3::repeat(0.5 * self.size);
        let drones = self.places.iter().flat_map(|place| [place - around, place + around]);
        let all = drones.chain(self.standing.into_iter().flatten());
        let corners = (Vector3::repeat(f64::MAX), Vector3::repeat(f64::MIN));
        let (low, high) = all.fold(corners, |(low, high), at| (low.inf(&at), high.sup(&at)));
        let (mut middle, mut reach) = (0.5 * (low + high), f64::max(0.5 * (high - low).norm(), 1.2));
        if reach > SHADOW_REACH {
            (middle, reach) = (*centre, SHADOW_REACH);
        }
        let from = 3 * self.sun;
        let direction = Vector3::from_column_slice(&self.data.light_xdir()[from..][..3]);
        let place = middle - SUN_DISTANCE * direction;
        self.data.light_xpos_mut()[from..][..3].copy_from_slice(place.as_slice());
        self.renderer.set_shadow_reach(reach)
    }

    /// Replaces the obstacles by obstacles with the same shapes in the same order. The next update draws them.
    ///
    /// # Errors
    /// [`Error::UnknownName`] for more obstacles than the scene has, and the errors of MuJoCo if it cannot copy the
    /// model.
    pub fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), Error> {
        self.stale = true;
        self.posed = None;
        for (index, obstacle) in obstacles.iter().enumerate() {
            let geom: GeomId = self.data.model().find(&World::obstacle_name(index))?;
            // the copy is safe: the renderer uses only meshes and textures of the shared model, which do not change
            let mut model = self.data.patch_model()?;
            place_geom(&mut model, geom, obstacle)?;
            let colour = obstacle.rgba.map(|x| x as f32);
            model.geom_rgba_mut()[4 * geom.index()..][..4].copy_from_slice(&colour);
            if let Some(own) = self.obstacles.get_mut(index) {
                *own = *obstacle;
            }
        }
        self.standing = bounds(obstacles.iter().chain(&self.markers));
        Ok(())
    }

    /// Moves the markers of the world, which must be in the same order. The next update draws them.
    ///
    /// # Errors
    /// [`Error::UnknownName`] for a marker that is not in the scene, and the errors of MuJoCo if it cannot copy the
    /// model.
    pub fn set_markers(&mut self, markers: &[Marker]) -> Result<(), Error> {
        self.stale = true;
        for (index, marker) in markers.iter().enumerate() {
            let geom: GeomId = self.data.model().find(&marker.name)?;
            place_geom(&mut self.data.patch_model()?, geom, &marker.body)?;
            if let Some(own) = self.markers.get_mut(index) {
                *own = marker.body;
            }
        }
        self.standing = bounds(self.obstacles.iter().chain(&self.markers));
        Ok(())
    }

    /// Sets the points (world frame, m) that the static views keep in the frame, together with the markers and the
    /// obstacles near them. The default is the start positions of the drones. See [`CameraPose::framing`].
    pub fn keep_in_frame(&mut self, points: &[Vector3<f64>]) {
        if self.stage.is_none() && self.kept == points {
            return;
        }
        (self.stage, self.posed) = (None, None);
        self.kept.clear();
        self.kept.extend(points.iter().filter(|point| point.iter().all(|x| x.is_finite())));
    }

    /// Sets a point (world frame, m) that the static views look at and a distance (m) around it, instead of the
    /// points that they [keep in the frame](Self::keep_in_frame).
    pub fn set_stage(&mut self, centre: [f64; 3], reach: f64) {
        self.stage = Some((centre.into(), reach));
    }

    /// Returns the camera of a view for an image size.
    fn camera(&mut self, view: View, size: ImageSize) -> Camera {
        if let (Some((stage, reach)), false) = (self.stage, view == View::Track) {
            let stage = Vector3::new(stage.x, stage.y, stage.z.max(0.75));
            let orbit = |distance: f64, azimuth: f64, elevation: f64| Camera::Free {
                lookat: stage.into(),
                distance,
                azimuth,
                elevation,
            };
            return match view {
                View::Fpv | View::Track | View::Fixed => orbit(1.7 + 2.2 * reach, 50.0, -20.0),
                View::Front => orbit(1.6 + 2.2 * reach, 180.0, -4.0),
                View::Top => orbit(1.6 + 2.8 * reach, 90.0, -90.0),
            };
        }
        match self.pose(view, size) {
            Some(pose) => pose.camera(),
            None => Camera::Fixed(self.cameras[0]),
        }
    }

    /// Returns the pose of a view for an image size after an [`update`](Self::update); `None` for `fpv`.
    pub fn pose(&mut self, view: View, size: ImageSize) -> Option<CameraPose> {
        let radius = CameraPose::radius_that_fills(self.size);
        let posed = match self.posed {
            Some((of, sized, pose)) if of == view && sized == size => pose,
            _ => {
                let markers = self.markers.iter().map(|marker| &marker.position);
                let points: Vec<_> = self.kept.iter().chain(markers).chain(&self.places).copied().collect();
                let pose = CameraPose::framing(view, &points, radius, &self.obstacles, size)?;
                self.posed = Some((view, size, pose));
                pose
            }
        };
        Some(match view {
            // the view keeps its direction and follows the drones
            View::Track => CameraPose::fitting(&self.places, radius, posed.azimuth, posed.elevation, size),
            _ => posed,
        })
    }

    /// Points the scene's camera at a view.
    pub(super) fn look(&mut self, view: View, size: ImageSize) -> Result<(), Error> {
        if view == View::Fpv {
            return self.look_from_board(0);
        }
        let camera = self.camera(view, size);
        self.seen_from(&camera, None)
    }

    /// Points the scene's camera along a drone's onboard camera. The camera sits inside the airframe, therefore the
    /// image omits that drone.
    pub(super) fn look_from_board(&mut self, drone: usize) -> Result<(), Error> {
        self.seen_from(&Camera::Fixed(self.cameras[drone]), Some(self.bodies[drone]))
    }

    pub(super) fn seen_from(&mut self, camera: &Camera, hidden: Option<BodyId>) -> Result<(), Error> {
        if self.stale {
            return Err(Error::NoCamera);
        }
        self.scene.look(&mut self.data, camera)?;
        self.scene.hide(hidden);
        Ok(())
    }
}

/// Makes propellers slightly transparent. A shadow map would draw stripes of their own shadows on the thin blades,
/// and transparent geoms receive no shadows. They have no depth either, therefore the onboard cameras of agents use
/// opaque propellers.
fn thin_blades(model: &mut Model, world: &World) -> Result<(), Error> {
    for index in 0..world.drones.len() {
        let blades: GeomId = model.find(&format!("{}_propellers", World::drone_name(index)))?;
        if let Ok(material) = usize::try_from(model.geom_matid()[blades.index()]) {
            model.patch().mat_rgba_mut()[4 * material + 3] = 0.85;
        }
    }
    Ok(())
}

/// Returns two corners of a box around obstacles; `None` without obstacles.
fn bounds<'a>(obstacles: impl Iterator<Item = &'a Obstacle>) -> Option<[Vector3<f64>; 2]> {
    obstacles
        .map(|obstacle| {
            let reach = Vector3::repeat(obstacle.shape.reach());
            [obstacle.position - reach, obstacle.position + reach]
        })
        .reduce(|[a, b], [c, d]| [a.inf(&c), b.sup(&d)])
}
