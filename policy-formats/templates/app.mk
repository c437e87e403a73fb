# Out-of-tree build of @name@: `make CRAZYFLIE_BASE=PATH` with the path of the firmware.
CRAZYFLIE_BASE ?= ../crazyflie-firmware

OOT_CONFIG := $(PWD)/app-config

include $(CRAZYFLIE_BASE)/tools/make/oot.mk
