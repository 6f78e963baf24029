"""One module per paper: conversion of its names and signs to ISO 230-1."""
