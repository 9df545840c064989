"""IMUs by grade: noise densities, bias walks and biases at power-up, with where they come from."""

from __future__ import annotations

from hybridlio.core.sensors import ImuNoise

# consumer-mems: InvenSense ICM-20948, as in Ouster's lidars; white noise of its data sheet: 0.015 °/s/√Hz and
# 230 µg/√Hz. Data sheets state no bias walk: twice that of the industrial grade. Biases at power-up: a fifth
# of the data sheet's 5 °/s and half of its 50 mg, as devices are trimmed when they are built into a lidar. Both are
# judgement.
# industrial: Analog Devices ADIS16448. White noise and walks as calibrated by Burri et al., "The EuRoC micro aerial
# vehicle datasets", IJRR 2016 (their sensor.yaml); biases at power-up of its data sheet, 1 σ: 0.5 °/s and 20 mg.
# tactical: Sensonor STIM300. White noise of its data sheet: 0.15 °/√h and 0.07 m/s/√h. Walks that reach its bias
# instabilities, 0.3 °/h and 0.05 mg, in a minute; biases at power-up of 10 °/h and 0.75 mg: judgement from the same
# sheet's repeatabilities.
IMU_GRADES: dict[str, ImuNoise] = {
    "consumer-mems": ImuNoise(2.6e-4, 2.3e-3, 4.0e-5, 6.0e-3, 1.7e-2, 2.5e-1),
    "industrial": ImuNoise(1.7e-4, 2.0e-3, 1.9e-5, 3.0e-3, 8.7e-3, 2.0e-1),
    "tactical": ImuNoise(4.4e-5, 1.2e-3, 1.9e-7, 6.3e-5, 4.8e-5, 7.4e-3),
}
