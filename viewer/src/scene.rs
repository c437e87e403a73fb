//! Images of the scene: the main view, and onboard cameras.

use std::sync::Arc;

use aviary::record::images::{depth_in_colour, segmentation_in_colour};
use aviary::record::plot::colour_of;
use aviary::vision::{CameraPose, Decor, ImageKind, ImageSize, SceneRenderer, View};
use aviary::world::{Marker, Obstacle, World};
use egui::{ColorImage, TextureHandle, TextureOptions};
use mujoco_rs::{Data, Model};
use nalgebra::Vector3;

use crate::error::ViewerError;
use crate::flight::Flight;
use crate::frame::Frame;
use crate::orbit::OrbitCamera;
use crate::ui::{Shows, Ui};

/// Images that the panels show.
#[derive(Default)]
pub(crate) struct SceneImages {
    pub main: Option<TextureHandle>,
    /// Onboard images, ordered by drone, then by kind.
    pub onboard: Vec<OnboardImage>,
}

/// Image of an onboard camera.
pub(crate) struct OnboardImage {
    pub drone: usize,
    /// Kind of the image.
    pub caption: String,
    pub texture: TextureHandle,
}

/// Renderers of a world.
pub(crate) struct SceneView {
    world: World,
    main: SceneRenderer,
    /// Renderer of the onboard cameras, created when one is shown: several samples per pixel would mix segments.
    onboard: Option<SceneRenderer>,
    contacts: Option<ContactScene>,
    obstacles: Arc<[Obstacle]>,
    markers: Arc<[Marker]>,
    /// Number of frames whose trail has been added, and the trails.
    trails: Trails,
    pixels: Vec<u8>,
    pub is_pretty: bool,
}

fn failed(error: impl std::fmt::Display) -> ViewerError {
    ViewerError::Scene { reason: error.to_string() }
}

impl SceneView {
    /// Creates the renderers. `is_pretty` selects shadows, reflections and several samples per pixel; `None` selects
    /// them on a GPU.
    pub fn new(world: &World, is_pretty: Option<bool>) -> Result<Self, ViewerError> {
        let is_pretty = match is_pretty {
            Some(is_pretty) => is_pretty,
            None => mujoco_rs::gl_info().is_ok_and(|info| !info.device.contains("software")),
        };
        let main = if is_pretty {
            SceneRenderer::for_people(world)
        } else {
            let effects = aviary::vision::VisualEffects { skybox: true, haze: true, ..Default::default() };
            SceneRenderer::new(world, mujoco_rs::Quality::FAST, effects)
        };
        Ok(Self {
            main: main.map_err(failed)?,
            world: world.clone(),
            onboard: None,
            contacts: None,
            obstacles: world.obstacles.as_slice().into(),
            markers: world.markers.as_slice().into(),
            trails: Trails::default(),
            pixels: Vec::new(),
            is_pretty,
        })
    }

    /// Draws the frame that the window shows.
    pub fn draw(
        &mut self,
        context: &egui::Context,
        flight: &Flight,
        ui: &mut Ui,
        images: &mut SceneImages,
    ) -> Result<(), ViewerError> {
        let frame = flight.frame().clone();
        self.adapt(flight, &frame)?;
        let size = ui.image_size();
        let states = frame.states();
        self.main.update(&states).map_err(failed)?;
        let pose = self.pose(flight, &frame, ui, size);
        self.trails.update(flight);
        self.add_shapes(flight, &frame, &ui.shows, ui.selected);
        if ui.shows.contacts {
            self.add_contacts(&frame)?;
        }
        self.pixels.resize(4 * size.pixels(), 0);
        match pose {
            Some(pose) => self.main.pose_rgba(&pose, size, &mut self.pixels).map_err(failed)?,
            None => self.main.onboard_rgba(ui.onboard_drone(&frame), size, &mut self.pixels).map_err(failed)?,
        }
        set(context, &mut images.main, "scene", size, &self.pixels);
        self.draw_onboard(context, &states, ui.camera_drones(&frame), &ui.shows, images)
    }

    /// Rebuilds the renderers for another scene, and moves obstacles and markers.
    fn adapt(&mut self, flight: &Flight, frame: &Frame) -> Result<(), ViewerError> {
        let world = &flight.episode.world;
        let is_same = |a: &World, b: &World| {
            let kind = |obstacle: &Obstacle| std::mem::discriminant(&obstacle.shape);
            let shapes = |world: &World| world.obstacles.iter().map(kind).collect::<Vec<_>>();
            let names = |world: &World| world.markers.iter().map(|m| m.name.clone()).collect::<Vec<_>>();
            a.drones == b.drones && shapes(a) == shapes(b) && names(a) == names(b)
        };
        if !is_same(&self.world, world) {
            *self = Self::new(world, Some(self.is_pretty))?;
        }
        if self.obstacles != frame.obstacles {
            for renderer in std::iter::once(&mut self.main).chain(&mut self.onboard) {
                renderer.set_obstacles(&frame.obstacles).map_err(failed)?;
            }
            self.contacts = None;
            self.obstacles = frame.obstacles.clone();
        }
        if self.markers != frame.markers {
            for renderer in std::iter::once(&mut self.main).chain(&mut self.onboard) {
                renderer.set_markers(&frame.markers).map_err(failed)?;
            }
            self.markers = frame.markers.clone();
        }
        Ok(())
    }

    /// Updates the camera and returns its pose; `None` for the onboard camera.
    fn pose(&mut self, flight: &Flight, frame: &Frame, ui: &mut Ui, size: ImageSize) -> Option<CameraPose> {
        if let Some(drone) = ui.followed.filter(|&drone| drone < frame.drones.len()) {
            ui.camera.lookat = frame.drones[drone].state.position;
        }
        match ui.preset {
            Some(View::Fpv) => None,
            Some(view) => {
                self.main.keep_in_frame(&flight.episode.extent);
                let pose = self.main.pose(view, size)?;
                ui.camera = OrbitCamera::of_pose(&pose);
                Some(pose)
            }
            None => Some(ui.camera.pose()),
        }
    }

    fn add_shapes(&mut self, flight: &Flight, frame: &Frame, shows: &Shows, selected: Option<usize>) {
        const WHITE: [f32; 4] = [1.0, 1.0, 1.0, 1.0];
        const ORANGE: [f32; 4] = [1.0, 0.55, 0.1, 1.0];
        const CYAN: [f32; 4] = [0.0, 0.85, 0.95, 1.0];
        let count = frame.drones.len();
        let arm = |drone: usize| flight.episode.world.drones[drone].params.arm_length.max(0.02);
        let main = &mut self.main;
        if shows.trails {
            for (drone, trail) in self.trails.points.iter().enumerate() {
                main.add_thread(trail, 2.0, colour_of(drone, count));
            }
        }
        for (drone, of_drone) in frame.drones.iter().enumerate() {
            let position = of_drone.state.position;
            let path = flight.episode.paths.get(drone).filter(|path| !path.is_empty());
            if shows.references {
                main.add_dots(of_drone.reference.as_slice(), 0.25 * arm(drone), WHITE);
                for piece in path.map(|path| path.chunks(4)).into_iter().flatten() {
                    main.add_thread(&piece[..piece.len().min(2)], 2.0, WHITE);
                }
            }
            if selected == Some(drone) {
                main.add_ring(position, Vector3::z(), 2.0 * arm(drone), 0.15 * arm(drone), ORANGE);
            }
            let weight = flight.episode.world.drones[drone].params.mass * flight.episode.world.gravity;
            let arrow = |main: &mut SceneRenderer, force: Vector3<f64>, rgba: [f32; 4]| {
                // the weight of a drone is four arm lengths
                let along = force * 4.0 * arm(drone) / weight.max(1e-9);
                if along.norm() > 0.05 * arm(drone) {
                    let to = (position + along).into();
                    main.add(Decor::Arrow { from: position.into(), to, radius: 0.1 * arm(drone) }, rgba);
                }
            };
            if shows.forces {
                let thrust = of_drone.state.attitude * Vector3::z() * of_drone.load.rotors.thrust;
                arrow(main, thrust, [0.3, 0.9, 0.4, 1.0]);
                arrow(main, of_drone.load.external.force_world - of_drone.push, [0.9, 0.3, 0.9, 1.0]);
            }
            arrow(main, of_drone.push, ORANGE);
        }
        if frame.wind.norm() > 1e-3 && shows.wind {
            self.add_wind(flight, frame, CYAN);
        }
    }

    /// Adds an arrow above the first drone and streaks that drift with the wind around it.
    fn add_wind(&mut self, flight: &Flight, frame: &Frame, rgba: [f32; 4]) {
        /// Half side of the cube of streaks, m.
        const REACH: f64 = 1.5;
        const STREAKS: u32 = 60;
        let arm = flight.episode.world.drones[0].params.arm_length.max(0.02);
        let (centre, wind) = (frame.drones[0].state.position, frame.wind);
        let from = centre + Vector3::z() * 4.0 * arm;
        self.main.add(Decor::Arrow { from: from.into(), to: (from + 0.25 * wind).into(), radius: 0.2 * arm }, rgba);
        let faint = [rgba[0], rgba[1], rgba[2], 0.5];
        for streak in 0..STREAKS {
            // points of a low-discrepancy sequence, which drift and re-enter on the other side
            let share = |base: f64| (f64::from(streak) * base).fract();
            let start = Vector3::new(share(0.754_877_666), share(0.569_840_291), share(0.819_172_513));
            let drift = start * 2.0 * REACH + wind * frame.time - centre;
            let local = drift.map(|x| x.rem_euclid(2.0 * REACH) - REACH);
            let at = centre + local;
            if at.z > 0.02 {
                let tail = at - 0.06 * wind;
                self.main.add(Decor::Line { from: tail.into(), to: at.into(), width: 1.5 }, faint);
            }
        }
    }

    /// Adds MuJoCo's contact points and normals of the shown state.
    fn add_contacts(&mut self, frame: &Frame) -> Result<(), ViewerError> {
        if self.contacts.is_none() {
            let mut world = self.world.clone();
            world.obstacles = self.obstacles.to_vec();
            self.contacts = Some(ContactScene::new(&world)?);
        }
        let Some(contacts) = &mut self.contacts else { return Ok(()) };
        for [position, normal] in contacts.find(frame)? {
            let to = position + 0.1 * normal;
            let red = [0.95, 0.2, 0.15, 1.0];
            self.main.add(Decor::Sphere { centre: position.into(), radius: 0.006 }, red);
            self.main.add(Decor::Arrow { from: position.into(), to: to.into(), radius: 0.003 }, red);
        }
        Ok(())
    }

    /// Draws the onboard cameras of drones in the kinds of images that are shown.
    fn draw_onboard(
        &mut self,
        context: &egui::Context,
        states: &[aviary::state::DroneState],
        drones: std::ops::Range<usize>,
        shows: &Shows,
        images: &mut SceneImages,
    ) -> Result<(), ViewerError> {
        const SIZE: ImageSize = ImageSize { width: 240, height: 180 };
        let kinds: Vec<_> = ImageKind::ALL.into_iter().zip(shows.onboard).filter(|(_, on)| *on).collect();
        if kinds.is_empty() {
            images.onboard.clear();
            return Ok(());
        }
        if self.onboard.is_none() {
            let mut world = self.world.clone();
            (world.obstacles, world.markers) = (self.obstacles.to_vec(), self.markers.to_vec());
            self.onboard = Some(SceneRenderer::for_observations(&world).map_err(failed)?);
        }
        let Some(renderer) = &mut self.onboard else { return Ok(()) };
        renderer.update(states).map_err(failed)?;
        let mut before = std::mem::take(&mut images.onboard).into_iter().map(|image| image.texture);
        for drone in drones {
            for (kind, _) in &kinds {
                let rgba = onboard_image(renderer, *kind, drone, SIZE)?;
                let mut texture = before.next();
                set(context, &mut texture, kind.name(), SIZE, &rgba);
                images.onboard.extend(texture.map(|texture| OnboardImage { drone, caption: caption(*kind), texture }));
            }
        }
        Ok(())
    }
}

/// Distance that is black in an image of depth, m.
const FAR: f32 = 5.0;

/// Returns the caption of an onboard image.
fn caption(kind: ImageKind) -> String {
    match kind {
        ImageKind::Depth => format!("depth, black from {FAR} m on"),
        ImageKind::Rgb | ImageKind::Segmentation => kind.name().into(),
    }
}

/// Draws an onboard image as RGBA pixels.
fn onboard_image(
    renderer: &mut SceneRenderer,
    kind: ImageKind,
    drone: usize,
    size: ImageSize,
) -> Result<Vec<u8>, ViewerError> {
    Ok(match kind {
        ImageKind::Rgb => {
            let mut rgba = vec![0; 4 * size.pixels()];
            renderer.onboard_rgba(drone, size, &mut rgba).map_err(failed)?;
            rgba
        }
        ImageKind::Depth => {
            let mut depth = vec![0.0; size.pixels()];
            renderer.onboard_depth(drone, size, &mut depth).map_err(failed)?;
            with_alpha(&depth_in_colour(&depth, FAR))
        }
        ImageKind::Segmentation => {
            let mut objects = vec![[0; 2]; size.pixels()];
            renderer.onboard_segmentation(drone, size, &mut objects).map_err(failed)?;
            with_alpha(&segmentation_in_colour(&objects))
        }
    })
}

/// Adds an opaque alpha channel to RGB pixels.
fn with_alpha(rgb: &[u8]) -> Vec<u8> {
    rgb.chunks_exact(3).flat_map(|rgb| [rgb[0], rgb[1], rgb[2], 255]).collect()
}

/// Sets or creates a texture.
fn set(context: &egui::Context, handle: &mut Option<TextureHandle>, name: &str, size: ImageSize, rgba: &[u8]) {
    let size = [size.width as usize, size.height as usize];
    let image = ColorImage::from_rgba_premultiplied(size, rgba);
    match handle {
        Some(handle) => handle.set(image, TextureOptions::LINEAR),
        None => *handle = Some(context.load_texture(name, image, TextureOptions::LINEAR)),
    }
}

/// Paths of the drones up to the shown frame.
#[derive(Default)]
struct Trails {
    points: Vec<Vec<Vector3<f64>>>,
    key: Option<(u64, usize)>,
}

impl Trails {
    /// Largest number of points of all trails.
    const MAX: usize = 6_000;

    fn update(&mut self, flight: &Flight) {
        let past = flight.past();
        let key = Some((flight.episode.number, past.len()));
        if self.key == key {
            return;
        }
        self.key = key;
        let drones = flight.frame().drones.len();
        let step = past.len().div_ceil((Self::MAX / drones.max(1)).max(1)).max(1);
        self.points.clear();
        for drone in 0..drones {
            let all = past.iter().step_by(step).chain(past.last());
            self.points.push(all.map(|frame| frame.drones[drone].state.position).collect());
        }
    }
}

/// MuJoCo's collision detection for the shown state. It has its own data, because the flight's must not change.
struct ContactScene {
    data: Data,
}

impl ContactScene {
    fn new(world: &World) -> Result<Self, ViewerError> {
        let model = Model::from_xml(&world.to_whole_mjcf().map_err(failed)?).map_err(failed)?;
        Ok(Self { data: Data::new(model).map_err(failed)? })
    }

    /// Returns the points and normals (world frame) of the contacts.
    fn find(&mut self, frame: &Frame) -> Result<Vec<[Vector3<f64>; 2]>, ViewerError> {
        for (position, drone) in self.data.qpos_mut().chunks_exact_mut(7).zip(&frame.drones) {
            position[..3].copy_from_slice(drone.state.position.as_slice());
            position[3..].copy_from_slice(&aviary::state::wxyz(&drone.state.attitude));
        }
        self.data.forward().map_err(failed)?;
        let contacts = self.data.contacts().filter(|contact| contact.is_active());
        Ok(contacts.map(|contact| [contact.position().into(), contact.normal().into()]).collect())
    }
}
