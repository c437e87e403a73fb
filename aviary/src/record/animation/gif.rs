use std::io::Write;

use color_quant::NeuQuant;
use gif::{DisposalMethod, Encoder, Frame, Repeat};

use super::{Animation, check_time};
use crate::record::RecordError;
use crate::record::picture::check;
use crate::vision::ImageSize;

/// An animated GIF that repeats for ever, written frame by frame.
///
/// Files are small because a pixel whose colour has hardly changed is left as it was, frames share a palette while it fits
/// them, and colours are not dithered. No pixel is off by more than the palette and a little of what an eye may notice.
pub struct GifAnimation<W: Write> {
    target: Target<W>,
    size: ImageSize,
    /// Length of a frame in the hundredths of a second that GIF counts in.
    delay: f64,
    frames: u32,
    palette: Option<Palette>,
    /// What a viewer shows now: RGB.
    shown: Vec<u8>,
    indices: Vec<u8>,
}

/// GIF's header holds the first palette, which only the first frame tells.
enum Target<W: Write> {
    Waiting(W),
    Begun(Encoder<W>),
    /// While one is made into the other, and after a failure of that.
    Lost,
}

/// Index of pixels that stay as they are; palettes have a colour less than GIF allows.
const STAYS: u8 = 255;

/// Squared distance in RGB below which a pixel stays as it is: four steps of 256 in every channel.
const UNNOTICED: u32 = 3 * 4 * 4;

/// A frame gets a palette of its own where the mean squared distance from the colours that there are grows by this much,
/// in squared steps of 256 …
const STRANGE: f64 = 12.0;

/// … or where this share of the pixels more than before is farther from every colour than [`FAR`].
const STRANGERS: f64 = 5e-4;

/// Squared distance at which a colour is another one: 20 steps of 256 in every channel.
const FAR: u32 = 3 * 20 * 20;

impl<W: Write> GifAnimation<W> {
    /// Begins an animation with so many seconds per frame (20 ms at least, in steps of 10 ms that even out).
    ///
    /// # Errors
    /// [`RecordError::Picture`] for a size that GIF does not have, [`RecordError::FrameTime`] for an impossible time.
    pub fn new(target: W, size: ImageSize, seconds_per_frame: f64) -> Result<Self, RecordError> {
        sides(size)?;
        check_time(seconds_per_frame)?;
        // viewers show anything shorter than two hundredths as a tenth
        let delay = (seconds_per_frame * 100.0).clamp(2.0, 6000.0);
        let (shown, indices) = (Vec::new(), vec![0; size.pixels()]);
        Ok(Self { target: Target::Waiting(target), size, delay, frames: 0, palette: None, shown, indices })
    }

    /// Ends the animation and gives the target back.
    ///
    /// # Errors
    /// [`RecordError::Animation`] where the target cannot be written.
    pub fn finish(self) -> Result<W, RecordError> {
        match self.target {
            Target::Waiting(target) => Ok(target),
            Target::Begun(encoder) => Ok(encoder.into_inner()?),
            Target::Lost => Err(RecordError::Animation(std::io::Error::other("it could not be begun").into())),
        }
    }

    fn encoder(&mut self, palette: &[u8]) -> Result<&mut Encoder<W>, RecordError> {
        if matches!(self.target, Target::Waiting(_))
            && let Target::Waiting(target) = std::mem::replace(&mut self.target, Target::Lost)
        {
            let [width, height] = sides(self.size)?;
            let mut encoder = Encoder::new(target, width, height, palette)?;
            encoder.set_repeat(Repeat::Infinite)?;
            self.target = Target::Begun(encoder);
        }
        match &mut self.target {
            Target::Begun(encoder) => Ok(encoder),
            _ => Err(RecordError::Animation(std::io::Error::other("it could not be begun").into())),
        }
    }

    /// Chooses a colour for every pixel and what is shown then: the smallest rectangle (left, top, right, bottom) that changes.
    fn choose(&mut self, rgb: &[u8], palette: &mut Palette) -> [usize; 4] {
        let width = self.size.width as usize;
        let mut changed = [usize::MAX, usize::MAX, 0, 0];
        let first = self.shown.is_empty();
        self.shown.resize(rgb.len(), 0);
        let pixels = rgb.chunks_exact(3).zip(self.shown.chunks_exact_mut(3)).zip(&mut self.indices);
        for (place, ((wanted, shown), index)) in pixels.enumerate() {
            let nearest = palette.nearest(wanted);
            let best = palette.colour(nearest);
            if !first && distance(shown, wanted) <= distance(best, wanted) + UNNOTICED {
                *index = STAYS;
                continue;
            }
            *index = nearest;
            shown.copy_from_slice(best);
            let (x, y) = (place % width, place / width);
            changed = [changed[0].min(x), changed[1].min(y), changed[2].max(x + 1), changed[3].max(y + 1)];
        }
        // a frame has at least a pixel
        if changed[2] == 0 { [0, 0, 1, 1] } else { changed }
    }
}

impl<W: Write> Animation for GifAnimation<W> {
    fn frame(&mut self, rgb: &[u8]) -> Result<(), RecordError> {
        check(self.size, rgb.len(), 3)?;
        let known = self.palette.take().and_then(|mut palette| {
            let (error, far) = palette.error(rgb);
            let strange = error - palette.made_for.0 > STRANGE || far - palette.made_for.1 > STRANGERS;
            (!strange).then_some(palette)
        });
        let mut palette = known.unwrap_or_else(|| Palette::of(rgb, self.frames));
        let [left, top, right, bottom] = self.choose(rgb, &mut palette);
        let row = self.size.width as usize;
        let buffer: Vec<u8> =
            (top..bottom).flat_map(|y| &self.indices[y * row + left..y * row + right]).copied().collect();
        // what rounding takes from one frame it gives to a later one, so that the whole runs at its speed
        let end = |frames: u32| (f64::from(frames) * self.delay).round();
        let delay = (end(self.frames + 1) - end(self.frames)) as u16;
        let frame = Frame {
            delay,
            dispose: DisposalMethod::Keep,
            transparent: Some(STAYS),
            left: left as u16,
            top: top as u16,
            width: (right - left) as u16,
            height: (bottom - top) as u16,
            // the first palette stands in the header
            palette: (palette.since > 0).then(|| palette.colours.clone()),
            buffer: buffer.into(),
            ..Frame::default()
        };
        self.encoder(&palette.colours)?.write_frame(&frame)?;
        self.palette = Some(palette);
        self.frames += 1;
        Ok(())
    }
}

/// 255 colours and a place for none.
struct Palette {
    colours: Vec<u8>,
    /// Nearest colour of colours with so many bits per channel, where it is known.
    nearest: Vec<Option<u8>>,
    /// Mean squared distance of the frame that it was made for, and the share of its pixels that are far from every colour.
    made_for: (f64, f64),
    /// The frame that it was made for.
    since: u32,
}

impl Palette {
    /// Bits per channel at which a nearest colour is looked up.
    const BITS: u32 = 6;

    fn of(rgb: &[u8], frame: u32) -> Self {
        // colours by their first five bits: how often, and the sums of their channels
        let mut bins = vec![(0_u64, [0_u64; 3]); 1 << 15];
        for pixel in rgb.chunks_exact(3) {
            let bin = pixel.iter().fold(0, |bin, &x| bin << 5 | usize::from(x >> 3));
            let (count, sums) = &mut bins[bin];
            *count += 1;
            sums.iter_mut().zip(pixel).for_each(|(sum, &x)| *sum += u64::from(x));
        }
        // what is rare, a thin line or a lamp, counts for more than its share: a floor would take all colours for itself
        let mut rgba = Vec::new();
        for (count, sums) in bins.into_iter().filter(|(count, _)| *count > 0) {
            let [r, g, b] = sums.map(|sum| (sum / count) as u8);
            for _ in 0..((count as f64).sqrt().ceil() as usize).min(64) {
                rgba.extend([r, g, b, 255]);
            }
        }
        // it learns from single pixels, and from not too few of them
        let whole = rgba.len();
        while rgba.len() < 4 * 8192 {
            rgba.extend_from_within(..whole);
        }
        let mut colours = NeuQuant::new(1, STAYS.into(), &rgba).color_map_rgb();
        colours.resize(3 * 256, 0);
        let mut palette =
            Self { colours, nearest: vec![None; 1 << (3 * Self::BITS)], made_for: (0.0, 0.0), since: frame };
        palette.made_for = palette.error(rgb);
        palette
    }

    fn colour(&self, index: u8) -> &[u8] {
        &self.colours[3 * usize::from(index)..][..3]
    }

    fn nearest(&mut self, colour: &[u8]) -> u8 {
        let place = colour.iter().fold(0, |place, &x| place << Self::BITS | usize::from(x >> (8 - Self::BITS)));
        if let Some(index) = self.nearest[place] {
            return index;
        }
        let colours = self.colours.chunks_exact(3).take(STAYS.into()).enumerate();
        let index = colours.min_by_key(|(_, known)| distance(known, colour)).map_or(0, |(index, _)| index as u8);
        self.nearest[place] = Some(index);
        index
    }

    /// Mean squared distance of a frame from the colours, and the share of its pixels that are far from all of them.
    fn error(&mut self, rgb: &[u8]) -> (f64, f64) {
        let (mut sum, mut far) = (0.0, 0.0);
        for pixel in rgb.chunks_exact(3) {
            let nearest = self.nearest(pixel);
            let distance = distance(self.colour(nearest), pixel);
            sum += f64::from(distance);
            far += f64::from(u8::from(distance > FAR));
        }
        let count = (rgb.len() / 3).max(1) as f64;
        (sum / count, far / count)
    }
}

/// Squared distance of two colours.
fn distance(a: &[u8], b: &[u8]) -> u32 {
    a.iter().zip(b).map(|(&a, &b)| u32::from(a.abs_diff(b)).pow(2)).sum()
}

fn sides(size: ImageSize) -> Result<[u16; 2], RecordError> {
    match (u16::try_from(size.width), u16::try_from(size.height)) {
        (Ok(width), Ok(height)) if width > 0 && height > 0 => Ok([width, height]),
        _ => Err(RecordError::Picture { size, got: 0, expected: size.pixels() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames as a viewer shows them, RGB, with their delays.
    fn shown(bytes: &[u8], size: ImageSize) -> Vec<(u16, Vec<u8>)> {
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(bytes).unwrap();
        let mut screen = vec![0; 3 * size.pixels()];
        let mut frames = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            for (place, pixel) in frame.buffer.chunks_exact(4).enumerate().filter(|(_, pixel)| pixel[3] > 0) {
                let (x, y) = (place % usize::from(frame.width), place / usize::from(frame.width));
                let at = (usize::from(frame.top) + y) * size.width as usize + usize::from(frame.left) + x;
                screen[3 * at..][..3].copy_from_slice(&pixel[..3]);
            }
            frames.push((frame.delay, screen.clone()));
        }
        frames
    }

    #[test]
    fn an_animation_holds_its_frames_and_runs_at_its_speed() {
        const SIZE: ImageSize = ImageSize { width: 3, height: 2 };
        let mut animation = GifAnimation::new(Vec::new(), SIZE, 1.0 / 24.0).unwrap();
        animation.frame(&[255; 18]).unwrap();
        assert!(animation.frame(&[0; 17]).is_err());
        for _ in 0..5 {
            animation.frame(&[0; 18]).unwrap();
        }
        let frames = shown(&animation.finish().unwrap(), SIZE);
        assert_eq!((frames.len(), frames[0].1[0], frames[1].1[0]), (6, 255, 0));
        // six frames of 1/24 s are a quarter of a second
        assert_eq!(frames.iter().map(|(delay, _)| delay).sum::<u16>(), 25);
    }

    #[test]
    fn every_frame_looks_as_it_should_and_what_stands_still_costs_little() {
        const SIZE: ImageSize = ImageSize { width: 64, height: 48 };
        // a slope of colours behind a disc that moves and, half-way, becomes red where nothing was
        let picture = |t: usize| -> Vec<u8> {
            let pixel = |place: usize| {
                let (x, y) = (place % 64, place / 64);
                let disc = (x as i32 - 10 - t as i32).pow(2) + (y as i32 - 24).pow(2) < 60;
                match (disc, t > 15) {
                    (true, false) => [20, 200, 40],
                    (true, true) => [250, 10, 30],
                    _ => [2 * x as u8, 3 * y as u8, 90],
                }
            };
            (0..64 * 48).flat_map(pixel).collect()
        };
        let mut animation = GifAnimation::new(Vec::new(), SIZE, 0.04).unwrap();
        (0..30).for_each(|t| animation.frame(&picture(t)).unwrap());
        let bytes = animation.finish().unwrap();
        let frames = shown(&bytes, SIZE);
        assert_eq!(frames.len(), 30);
        for (t, (_, frame)) in frames.iter().enumerate() {
            let wanted = picture(t);
            let errors: Vec<_> =
                frame.chunks_exact(3).zip(wanted.chunks_exact(3)).map(|(a, b)| distance(a, b)).collect();
            let mean = f64::from(errors.iter().sum::<u32>()) / errors.len() as f64;
            assert!(mean < 60.0, "frame {t}: mean {mean}");
            assert!(errors.iter().all(|&error| error < 3 * 40 * 40), "frame {t}: {:?}", errors.iter().max());
        }
        // 30 frames of full size would take 30 times the first one
        let mut still = GifAnimation::new(Vec::new(), SIZE, 0.04).unwrap();
        still.frame(&picture(0)).unwrap();
        let first = still.finish().unwrap().len();
        assert!(4 * bytes.len() < 30 * first, "{} against {first}", bytes.len());
    }

    #[test]
    fn sizes_that_gif_does_not_have_are_refused_and_no_frame_is_no_file() {
        for size in [(0, 4), (4, 0), (70_000, 4)] {
            assert!(GifAnimation::new(Vec::new(), ImageSize { width: size.0, height: size.1 }, 0.1).is_err());
        }
        let empty = GifAnimation::new(Vec::new(), ImageSize { width: 2, height: 2 }, 0.1).unwrap();
        assert!(empty.finish().unwrap().is_empty());
    }
}
