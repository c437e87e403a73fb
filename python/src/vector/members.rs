//! Environments of a batch, whose steps and resets write to the memory of numpy arrays.

use aviary::vector::VecEnv;
use pyo3::prelude::*;

use super::buffers::Numbers;
use super::outputs::{Images, StepMemory};
use crate::error::env_error;

/// Environments of a batch and what does not change its place from step to step.
pub struct Members {
    pub env: Box<dyn VecEnv>,
    /// Environment on the CPU with the constants of all, if these are elsewhere.
    pub probe: Option<Box<dyn VecEnv>>,
    images: Images,
    has_images: bool,
    /// True if the images show the present states.
    pub images_are_current: bool,
    /// Environments whose episodes ended in the last step.
    pub ended: Vec<usize>,
}

impl Members {
    /// Creates the environments of a batch without results.
    pub fn new(env: Box<dyn VecEnv>, probe: Option<Box<dyn VecEnv>>, images: Images) -> Self {
        let has_images = env.observation_space().kind.has_images();
        Self { env, probe, images, has_images, images_are_current: false, ended: Vec::new() }
    }

    /// Steps the environments and returns true if an episode has ended.
    pub fn step(&mut self, actions: Numbers<'_>, memory: &mut StepMemory) -> PyResult<bool> {
        // the step must not overwrite its actions
        let addresses = actions.addresses();
        if memory.overlaps(&addresses) || self.images.overlaps(&addresses) {
            return match actions {
                Numbers::Single(actions) => {
                    let copy = actions.to_vec();
                    self.step_apart(Numbers::Single(&copy), memory)
                }
                Numbers::Double(actions) => {
                    let copy = actions.to_vec();
                    self.step_apart(Numbers::Double(&copy), memory)
                }
            };
        }
        self.step_apart(actions, memory)
    }

    /// Steps the environments with actions outside the memory of the results.
    fn step_apart(&mut self, actions: Numbers<'_>, memory: &mut StepMemory) -> PyResult<bool> {
        self.images_are_current = false;
        match actions {
            Numbers::Single(actions) => self.env.step(actions, memory.step()),
            Numbers::Double(actions) => self.env.step_f64(actions, memory.step()),
        }
        .map_err(env_error)?;
        self.render_images(None)?;
        memory.find_ended(&mut self.ended);
        Ok(!self.ended.is_empty())
    }

    /// Renders the images of all environments, or of those in a mask if the other images are current.
    fn render_images(&mut self, mask: Option<&[bool]>) -> PyResult<()> {
        if !self.has_images {
            return Ok(());
        }
        match mask.filter(|_| self.images_are_current) {
            Some(mask) => self.env.render_images_where(mask, self.images.output()),
            None => self.env.render_images(self.images.output()),
        }
        .map_err(env_error)?;
        self.images_are_current = true;
        Ok(())
    }

    /// Starts an episode in every environment of a mask.
    pub fn reset(&mut self, mask: &[bool], seeds: &Seeds, memory: &mut StepMemory) -> PyResult<()> {
        let observations = memory.observations();
        let done = match seeds {
            Seeds::Same(seed) => self.env.reset_where(mask, *seed, observations),
            Seeds::Each(seeds) => self.env.reset_with_seeds(mask, seeds, observations),
        };
        self.images_are_current &= done.is_ok();
        done.map_err(env_error)?;
        self.render_images(Some(mask))
    }
}

/// Seeds of a reset.
#[derive(FromPyObject)]
pub enum Seeds {
    /// One seed, of which every environment uses its own stream.
    Same(Option<u64>),
    /// A seed per environment.
    Each(Vec<Option<u64>>),
}
